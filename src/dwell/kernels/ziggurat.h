#pragma once

// Standard normals by the ziggurat of Marsaglia and Tsang (2000, DOI 10.18637/jss.v005.i08). They
// equal NumPy's normals from the same stream, except that the last bit may differ in the tail.

#include <array>
#include <cstddef>
#include <cstdint>

#include "elementary.h"
#include "sfc64.h"
#include "ziggurat_tables.h"

namespace dwell {

// Begin of the tail, which is the end of the lowest layer.
constexpr double kTail = 3.6541528853610088;

// Width of a step by the last 9 bits of a random number: the layer, and above it the sign.
inline constexpr std::array<double, 512> kSignedStep = [] {
  std::array<double, 512> steps{};
  for (std::size_t layer = 0; layer < 256; ++layer) {
    steps[layer] = kStep[layer];
    steps[256 + layer] = -kStep[layer];
  }
  return steps;
}();

// A normal beyond kTail, or below -kTail; bit 8 of `steps`, from the previous random number,
// selects the sign.
[[gnu::noinline]] inline double normal_in_tail(Sfc64& stream, uint64_t steps) noexcept {
  for (;;) {
    const double beyond = -(1.0 / kTail) * log(1.0 - stream.uniform());
    const double height = -log(1.0 - stream.uniform());
    if (height + height > beyond * beyond) {
      return (steps >> 8 & 1) != 0 ? -(kTail + beyond) : kTail + beyond;
    }
  }
}

inline void draw_normals(Sfc64& stream, double* normals, int64_t count) noexcept {
  // The state is in registers while the loop runs.
  Sfc64 state = stream;
  for (int64_t i = 0; i < count;) {
    const uint64_t bits = state.next();
    const uint64_t layer = bits & 255;
    const uint64_t steps = bits >> 9 & 0xfffffffffffff;
    const double x = static_cast<double>(static_cast<int64_t>(steps)) * kSignedStep[bits & 511];
    normals[i] = x;
    if (steps < kInside[layer]) [[likely]] {
      ++i;
    } else if (layer == 0) {
      normals[i++] = normal_in_tail(state, steps);
    } else {
      // Part of the layer is above the density: keep x if a random height is below the density.
      const double low = kDensity[layer];
      const double height = (kDensity[layer - 1] - low) * state.uniform() + low;
      i += height < exp(-0.5 * x * x);
    }
  }
  stream = state;
}

}  // namespace dwell
