// Standard normals of a stream, for test_ziggurat.py.

#include "ziggurat.h"

#include "export.h"

DWELL_EXPORT void normals(dwell::Sfc64* stream, int64_t n, double* out) noexcept {
  dwell::draw_normals(*stream, out, n);
}
