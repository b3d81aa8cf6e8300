#pragma once

// SFC64 (Doty-Humphrey 2010, PractRand): the bit generator of every stream, the same as NumPy's.

#include <bit>
#include <cstdint>

namespace dwell {

struct Sfc64 {
  uint64_t a;
  uint64_t b;
  uint64_t c;
  uint64_t counter;

  uint64_t next() noexcept {
    const uint64_t drawn = a + b + counter++;
    a = b ^ (b >> 11);
    b = c + (c << 3);
    c = std::rotl(c, 24) + drawn;
    return drawn;
  }

  // A number in [0, 1), 53 bits.
  double uniform() noexcept { return static_cast<double>(next() >> 11) * 0x1p-53; }
};

}  // namespace dwell
