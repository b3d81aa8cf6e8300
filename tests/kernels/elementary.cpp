// The elementary functions over arrays, for test_elementary.py.

#include "elementary.h"

#include "export.h"

DWELL_EXPORT void sines_and_cosines(const double* angles, int64_t n, double* sines,
                                    double* cosines) noexcept {
  for (int64_t i = 0; i < n; ++i) {
    const dwell::SineCosine both = dwell::sine_cosine(angles[i]);
    sines[i] = both.sine;
    cosines[i] = both.cosine;
  }
}

DWELL_EXPORT void exponentials(const double* x, int64_t n, double* out) noexcept {
  for (int64_t i = 0; i < n; ++i) out[i] = dwell::exp(x[i]);
}

DWELL_EXPORT void logarithms(const double* x, int64_t n, double* out) noexcept {
  for (int64_t i = 0; i < n; ++i) out[i] = dwell::log(x[i]);
}

DWELL_EXPORT void cube_roots(const double* x, int64_t n, double* out) noexcept {
  for (int64_t i = 0; i < n; ++i) out[i] = dwell::cube_root(x[i]);
}
