// The elementary functions that Python calls, and sums of few values.

#include "elementary.h"

#include "export.h"

DWELL_EXPORT void dwell_logarithms(const double* x, int64_t count, double* out) noexcept {
  for (int64_t i = 0; i < count; ++i) out[i] = dwell::log(x[i]);
}

DWELL_EXPORT double dwell_cube_root(double x) noexcept { return dwell::cube_root(x); }

// Writes the mean of values, the sum of the squares of their deviations from it, and the sum of the
// products of successive ones.
DWELL_EXPORT void dwell_moments(const double* x, int64_t count, double* out) noexcept {
  double sum = 0.0, squares = 0.0, products = 0.0;
  // Of equal values exactly that, and no deviation.
  for (int64_t i = 0; i < count; ++i) sum += x[i] - x[0];
  const double mean = x[0] + sum / static_cast<double>(count);
  for (int64_t i = 0; i < count; ++i) {
    squares += (x[i] - mean) * (x[i] - mean);
    if (i > 0) products += (x[i - 1] - mean) * (x[i] - mean);
  }
  out[0] = mean;
  out[1] = squares;
  out[2] = products;
}
