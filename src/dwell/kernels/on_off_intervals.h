#pragma once

// Times at which a disturbance is on, and how strongly.

#include <cstdint>
#include <limits>

namespace dwell {

// Number of strengths: those of a ramp's steps, and none (dwell.model.scenario.RAMP_STEPS).
constexpr int64_t kLevels = 32;
constexpr int64_t kAtNoTime = std::numeric_limits<int64_t>::max();

// Intervals in order, none of which begins before the one ahead of it has ended; disturbances.py
// has the same struct.
struct OnOffIntervals {
  const int64_t* begin_ns;
  const int64_t* end_ns;
  const int64_t* levels;
  int64_t count;
  int64_t passed;  // begins and ends that are over

  int64_t next_ns() const noexcept {
    if (passed == 2 * count) return kAtNoTime;
    return (on() ? end_ns : begin_ns)[passed / 2];
  }
  bool on() const noexcept { return passed % 2 != 0; }
  // That of the interval that is on, or comes next.
  int64_t level() const noexcept { return levels[passed / 2]; }
};

}  // namespace dwell
