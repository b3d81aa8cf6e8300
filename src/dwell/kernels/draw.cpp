// Samples a path of a random process, one value per cycle: independent values, or an AR(1) process;
// as floating-point numbers, or in whole nanoseconds.

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>

#include "elementary.h"
#include "export.h"
#include "nanoseconds.h"
#include "rows.h"
#include "ziggurat.h"

namespace dwell {
namespace {

// Kinds of paths.
constexpr int64_t kConstant = 0;
constexpr int64_t kUniform = 1;
constexpr int64_t kNormal = 2;
constexpr int64_t kLogNormal = 3;

// Values per block, which stay in the first-level cache.
constexpr int64_t kBlock = 512;

// x[t] = r x[t-1] + sqrt(1 - r^2) e[t]; x[0] = e[0].
void remember(DrawnPath& path, double* normals, int64_t count) noexcept {
  const bool begins = std::isnan(path.last);
  double last = begins ? normals[0] : path.last;
  for (int64_t i = begins ? 1 : 0; i < count; ++i) {
    last = path.correlation * last + path.gain * normals[i];
    normals[i] = last;
  }
  path.last = last;
}

void draw_block(DrawnPath& path, double* values, int64_t count) noexcept {
  switch (path.kind) {
    case kConstant:
      std::fill_n(values, count, path.location);
      return;
    case kUniform: {
      Sfc64 stream = path.stream;
      for (int64_t i = 0; i < count; ++i) {
        values[i] = path.location + path.spread * stream.uniform();
      }
      path.stream = stream;
      return;
    }
    case kNormal:
      draw_normals(path.stream, values, count);
      for (int64_t i = 0; i < count; ++i) {
        values[i] = std::max(values[i] * path.spread + path.location, path.least);
      }
      return;
    case kLogNormal:
      draw_normals(path.stream, values, count);
      if (path.correlation != 0.0) remember(path, values, count);
      for (int64_t i = 0; i < count; ++i) values[i] = exp(values[i] * path.spread + path.location);
      return;
    default:
      return;
  }
}

// Rounds milliseconds to whole nanoseconds.
void round_block(const double* ms, int64_t count, int64_t* ns) noexcept {
  // For a number below 2^51 (26 days), the last bits of the sum are the whole number, and its first
  // bits equal the first bits of the summand.
  constexpr uint64_t kRound = std::bit_cast<uint64_t>(0x1.8p52);
  uint64_t all = 0;
  for (int64_t i = 0; i < count; ++i) {
    const uint64_t sum = std::bit_cast<uint64_t>(ms[i] * kNsPerMs + 0x1.8p52);
    all |= sum;
    ns[i] = static_cast<int64_t>(sum - kRound);
  }
  if (all >> 52 == kRound >> 52) return;
  for (int64_t i = 0; i < count; ++i) ns[i] = round_ns(std::min(ms[i] * kNsPerMs, kHorizonNs));
}

void scale_block(double* values, const double* factors, int64_t count) noexcept {
  for (int64_t i = 0; i < count; ++i) values[i] *= factors[i];
}

}  // namespace

// Samples the next values of a path.
DWELL_EXPORT void dwell_draw(DrawnPath* path, int64_t count, double* values) noexcept {
  for (int64_t i = 0; i < count; i += kBlock) {
    draw_block(*path, values + i, std::min(kBlock, count - i));
  }
}

// Samples the next values of a path, ms, multiplies them by factors unless null, and rounds to ns.
DWELL_EXPORT void dwell_draw_ns(DrawnPath* path, int64_t count, const double* factors,
                                int64_t* ns) noexcept {
  double block[kBlock];
  for (int64_t i = 0; i < count; i += kBlock) {
    const int64_t n = std::min(kBlock, count - i);
    draw_block(*path, block, n);
    if (factors != nullptr) scale_block(block, factors + i, n);
    round_block(block, n, ns + i);
  }
}

// Multiplies values, ms, by factors unless null, and rounds them to ns.
DWELL_EXPORT void dwell_round_ns(const double* ms, int64_t count, const double* factors,
                                 int64_t* ns) noexcept {
  double block[kBlock];
  for (int64_t i = 0; i < count; i += kBlock) {
    const int64_t n = std::min(kBlock, count - i);
    std::copy_n(ms + i, n, block);
    if (factors != nullptr) scale_block(block, factors + i, n);
    round_block(block, n, ns + i);
  }
}

}  // namespace dwell
