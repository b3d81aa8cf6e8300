// Errors of estimates from few samples: sums of steps, and errors of percentiles
// (sampling_errors.py).

#include <algorithm>
#include <cmath>

#include "export.h"
#include "rows.h"

namespace dwell {
namespace {

// Without this comparison clang's std::sort of numbers calls the C++ library, which is not linked.
constexpr auto kIsLess = [](auto one, auto other) { return one < other; };
// Place of the 95th percentile, and distance of its limits in errors of the place.
constexpr f64 kPlace = 0.95, kOff = 2.0;

// Adds up in the order of NumPy: eight sums in parallel; a longer array is halved first.
f64 pairwise_sum(const f64* values, i64 n) {
  constexpr i64 kBlock = 128, kSums = 8;
  if (n > kBlock) {
    const i64 half = n / 2 - n / 2 % kSums;
    return pairwise_sum(values, half) + pairwise_sum(values + half, n - half);
  }
  f64 sum = -0.0;
  i64 i = 0;
  if (n >= kSums) {
    f64 sums[kSums];
    std::copy(values, values + kSums, sums);
    for (i = kSums; i < n - n % kSums; ++i) sums[i % kSums] += values[i];
    sum = ((sums[0] + sums[1]) + (sums[2] + sums[3])) + ((sums[4] + sums[5]) + (sums[6] + sums[7]));
  }
  for (; i < n; ++i) sum += values[i];
  return sum;
}

// Returns the error of the 95th percentile of `n` values if its place has the error `off`. `at`
// returns the value at a place; the places of its calls ascend. The values two errors from the
// place are the limits (Woodruff, DOI 10.2307/2280781). The error is half the larger distance.
template <class At>
f64 percentile_error(i64 n, f64 off, At at) {
  const f64 last = static_cast<f64>(n - 1);
  const auto place = [&](f64 share) { return static_cast<i64>(std::rint(share * last)); };
  const f64 low = at(std::max(place(kPlace - kOff * off), i64{0}));
  const f64 usual = at(place(kPlace));
  const f64 high = at(std::min(place(kPlace + kOff * off), n - 1));
  return std::max(high - usual, usual - low) / 2;
}

// Writes the mean of `n` values, the sum of the squares of their deviations from it, and the sum of
// the products of successive deviations.
template <class Value>
void write_moments(i64 n, Value value, f64* out) {
  f64 sum = 0.0, squares = 0.0, products = 0.0;
  // Equal values have exactly this mean, and no deviation.
  for (i64 i = 0; i < n; ++i) sum += value(i) - value(0);
  const f64 mean = value(0) + sum / static_cast<f64>(n);
  for (i64 i = 0; i < n; ++i) {
    squares += (value(i) - mean) * (value(i) - mean);
    if (i > 0) products += (value(i - 1) - mean) * (value(i) - mean);
  }
  out[0] = mean;
  out[1] = squares;
  out[2] = products;
}

}  // namespace
}  // namespace dwell

using namespace dwell;

// Writes the sums of `n` steps of `width` numbers. L95 and V_D, each followed by its declared
// value, give the moments of the metric, the moments of the differences, and the sum of the
// absolute differences. Every other column gives its sum.
DWELL_EXPORT void dwell_step_sums(const f64* steps, i64 n, i64 width, f64* out) noexcept {
  for (i64 column = 0; column < 4; column += 2, out += 7) {
    const auto shown = [&](i64 i) { return steps[i * width + column]; };
    const auto more = [&](i64 i) { return shown(i) - steps[i * width + column + 1]; };
    write_moments(n, shown, out);
    write_moments(n, more, out + 3);
    out[6] = 0.0;
    for (i64 i = 0; i < n; ++i) out[6] += std::abs(more(i));
  }
  for (i64 column = 4; column < width; ++column) {
    f64 sum = 0.0;
    for (i64 i = 0; i < n; ++i) sum += steps[i * width + column];
    *out++ = sum;
  }
}

// Writes the lost share of a pool's values, and the error of the 95th percentile of the finite
// values, which is no less than the error of their mean. `scratch` has room for all values.
DWELL_EXPORT void dwell_held_error(const Pool* pool, f64* scratch, f64* out) noexcept {
  const f64* values = pool->held + pool->first;
  const i64 n = pool->size;
  f64* end = std::copy_if(values, values + n, scratch, [](f64 ms) { return std::isfinite(ms); });
  const i64 known = end - scratch;
  out[0] = static_cast<f64>(n - known) / static_cast<f64>(std::max(n, i64{1}));
  out[1] = 0.0;
  if (known < 2) return;
  std::sort(scratch, end, kIsLess);
  const f64 count = static_cast<f64>(std::max(pool->measured, i64{2}));
  const auto at = [&](i64 place) { return scratch[place]; };
  const f64 of_place = percentile_error(known, std::sqrt(0.05 * (1.0 - 0.05) / count), at);
  const f64 mean = pairwise_sum(scratch, known) / static_cast<f64>(known);
  for (f64* value = scratch; value != end; ++value) *value = (*value - mean) * (*value - mean);
  const f64 deviation = std::sqrt(pairwise_sum(scratch, known) / static_cast<f64>(known));
  // A deviation from few values is uncertain, so enlarge it.
  const f64 few = (count + 1.0) / (count - 1.0);
  out[1] = std::max(few * deviation / std::sqrt(count), of_place);
}

// Returns the error of the 95th percentile of latencies; changes their order.
DWELL_EXPORT f64 dwell_tail_error(i64* latency_ns, i64 n, f64 most_ms, f64 off) noexcept {
  i64 from = 0;
  return percentile_error(n, off, [&](i64 place) {
    if (place >= from) {
      std::nth_element(latency_ns + from, latency_ns + place, latency_ns + n, kIsLess);
      from = place + 1;
    }
    return std::min(static_cast<f64>(latency_ns[place]) / 1e6, most_ms);
  });
}
