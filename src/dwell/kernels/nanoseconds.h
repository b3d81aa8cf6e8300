#pragma once

// Times in whole nanoseconds.

#include <cstdint>

namespace dwell {

constexpr double kNsPerMs = 1e6;
// Longest duration in a realisation (dwell.model.instants.HORIZON_NS).
constexpr double kHorizonNs = 9.2e18;

// Rounds half to even; from 0 to 2^63.
inline int64_t round_ns(double ns) noexcept {
  // A double from 2^52 on has no fraction, so adding 2^52 rounds.
  return static_cast<int64_t>(ns < 0x1p52 ? (ns + 0x1p52) - 0x1p52 : ns);
}

}  // namespace dwell
