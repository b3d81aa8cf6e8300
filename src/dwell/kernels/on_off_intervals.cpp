// Samples an alternating renewal process: off for a time, then on for a time, and so on.

#include <algorithm>
#include <cstdint>

#include "export.h"
#include "nanoseconds.h"

// Adds up times off and times on, both in units of `unit_ns`, starting `elapsed_ns` after
// `since_ns`; returns the number of intervals that begin before the horizon.
DWELL_EXPORT int64_t dwell_alternate(const double* off, const double* on, int64_t count,
                                     double unit_ns, double since_ns, double* elapsed_ns,
                                     double horizon_ns, int64_t* begin_ns,
                                     int64_t* end_ns) noexcept {
  double end = since_ns + *elapsed_ns;
  for (int64_t i = 0; i < count; ++i) {
    const double length = on[i] * unit_ns;
    const double ended = end;
    *elapsed_ns += off[i] * unit_ns + length;
    end = since_ns + *elapsed_ns;
    // Rounding may move the difference before the end of the previous interval.
    const double begin = std::max(end - length, ended);
    if (begin >= horizon_ns) return i;
    begin_ns[i] = dwell::round_ns(begin);
    end_ns[i] = dwell::round_ns(std::min(end, dwell::kHorizonNs));
  }
  return count;
}
