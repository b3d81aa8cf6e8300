#pragma once

// Standard normals by the ziggurat of Marsaglia and Tsang (2000, DOI 10.18637/jss.v005.i08): those
// that NumPy draws from the same stream, but that in the tail the last bit may be another.

#include <array>
#include <cstddef>
#include <cstdint>

#include "elementary.h"
#include "sfc64.h"
#include "ziggurat_tables.h"

namespace dwell {

// Where the lowest layer ends and the tail begins.
constexpr double kTail = 3.6541528853610088;

// Width of a step by the last 9 bits of a draw: the layer, and above it the sign.
inline constexpr std::array<double, 512> kSignedStep = [] {
  std::array<double, 512> steps{};
  for (std::size_t layer = 0; layer < 256; ++layer) {
    steps[layer] = kStep[layer];
    steps[256 + layer] = -kStep[layer];
  }
  return steps;
}();

// A normal beyond kTail, or its mirror image; `steps` are those of the draw that led here.
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
      // Where the layer sticks out of the density, a height decides whether x counts.
      const double low = kDensity[layer];
      const double height = (kDensity[layer - 1] - low) * state.uniform() + low;
      i += height < exp(-0.5 * x * x);
    }
  }
  stream = state;
}

}  // namespace dwell
