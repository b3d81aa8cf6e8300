// The elementary functions that Python calls.

#include "elementary.h"

#include "export.h"

DWELL_EXPORT void dwell_logarithms(const double* x, int64_t count, double* out) noexcept {
  for (int64_t i = 0; i < count; ++i) out[i] = dwell::log(x[i]);
}

DWELL_EXPORT double dwell_cube_root(double x) noexcept { return dwell::cube_root(x); }
