// Sums of times that may exceed 64 bits: later instants become `kLastNs`, which is never reached.
#pragma once

#include <algorithm>

#include "rows.h"

namespace dwell {

// The largest number of nanoseconds that is exact as an integer and as a double.
constexpr i64 kLastNs = INT64_MAX - 1023;

// The instant a duration after t; both are at least 0 and at most `kLastNs`.
inline i64 later(i64 t, i64 duration) { return t + std::min(duration, kLastNs - t); }

// A duration of whole nanoseconds, at most `kLastNs`.
inline i64 whole_ns(f64 duration) {
  return static_cast<i64>(std::min(duration, static_cast<f64>(kLastNs)));
}

// The least number of whole nanoseconds that is no shorter than a duration; at most `kLastNs`.
inline i64 ceil_ns(f64 duration) {
  // Without SSE4.1, std::ceil takes longer.
  const f64 most = std::min(duration, static_cast<f64>(kLastNs));
  const i64 whole = static_cast<i64>(most);
  return whole + (static_cast<f64>(whole) < most ? 1 : 0);
}

}  // namespace dwell
