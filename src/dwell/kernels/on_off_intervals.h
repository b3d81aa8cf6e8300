#pragma once

// Times and strengths of a disturbance.

#include <limits>

#include "rows.h"

namespace dwell {

constexpr i64 kAtNoTime = std::numeric_limits<i64>::max();

inline bool is_on(const OnOffIntervals& intervals) noexcept { return intervals.passed % 2 != 0; }

inline i64 next_ns(const OnOffIntervals& intervals) noexcept {
  const i64 passed = intervals.passed;
  if (passed == 2 * intervals.count) return kAtNoTime;
  return (is_on(intervals) ? intervals.end_ns : intervals.begin_ns)[passed / 2];
}

// Level of the present interval, or of the next if the disturbance is off.
inline i64 level(const OnOffIntervals& intervals) noexcept {
  return intervals.levels[intervals.passed / 2];
}

}  // namespace dwell
