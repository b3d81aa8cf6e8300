// Pools: the measured and the declared values of each part of a cycle (pool.py).

#include <algorithm>
#include <cmath>
#include <limits>

#include "elementary.h"
#include "export.h"
#include "rows.h"

namespace dwell {

// Places p of values among known values: the sums of -log(1 - p), of -log(p), and of p.
struct PlaceSums {
  i64 size;
  f64 larger, smaller, places;
};

namespace {

// As in pool.py.
constexpr i64 kLargest = 200, kEnough = 12;
constexpr f64 kMoved = 0.75, kShifted = 4.0, kAlike = 2.0;
// Room for the newest values, and for their chunks (pools.py).
constexpr i64 kRoom = 408;
// Parts of the range of declared values (pools.py).
constexpr i64 kGuideParts = 512;
// Why Python must look at a pool: the values of the window were not added; they were added; they
// were added to a pool that is not as declared.
constexpr i64 kNotAdded = 1, kAdded = 2, kGrown = 3;

// The first of ascending values that is at least `value`. The next half is computed without a
// branch, because branch prediction fails here.
const f64* first_not_below(const f64* known, i64 n, f64 value) {
  if (n == 0) return known;
  while (n > 1) {
    const i64 half = n / 2;
    known += half * static_cast<i64>(known[half - 1] < value);
    n -= half;
  }
  return known + (*known < value ? 1 : 0);
}

// Returns the part of the declared range that contains a value, or the nearest end.
i64 part_of(f64 value, f64 low, f64 parts_per_ms) {
  const f64 place = (value - low) * parts_per_ms;
  if (place >= static_cast<f64>(kGuideParts)) return kGuideParts - 1;
  return place > 0.0 ? static_cast<i64>(place) : 0;
}

// Returns the first declared value that is at least `value`, searching only the value's part.
const f64* first_declared_not_below(const Pool& pool, f64 value) {
  const i32* part = pool.guide + part_of(value, pool.guide_low, pool.guide_parts_per_ms);
  return first_not_below(pool.known + part[0], part[1] - part[0], value);
}

template <class Search>
void add_places(const f64* known, i64 n_known, const f64* values, i64 n, f64 patience_ms,
                PlaceSums& out, Search search) {
  // Multiply this many places before one logarithm; their product cannot underflow.
  constexpr i64 kTogether = 16;
  out = {n, 0.0, 0.0, 0.0};
  f64 beyond = 1.0, below = 1.0;
  for (i64 i = 0; i < n; ++i) {
    const f64 value = values[i] > patience_ms ? std::numeric_limits<f64>::infinity() : values[i];
    const f64* first = search(value);
    const f64* last = first;
    if (first != known + n_known && *first == value) {
      last = std::upper_bound(first, known + n_known, value);
    }
    const f64 p =
        static_cast<f64>((first - known) + (last - known) + 1) / static_cast<f64>(2 * n_known + 2);
    beyond *= 1.0 - p;
    below *= p;
    out.places += p;
    if (i % kTogether == kTogether - 1 || i == n - 1) {
      out.larger -= dwell::log(beyond);
      out.smaller -= dwell::log(below);
      beyond = below = 1.0;
    }
  }
}

void add_places(const f64* known, i64 n_known, const f64* values, i64 n, f64 patience_ms,
                PlaceSums& out) {
  add_places(known, n_known, values, n, patience_ms, out,
             [&](f64 value) { return first_not_below(known, n_known, value); });
}

void add_declared_places(const Pool& pool, const f64* values, i64 n, PlaceSums& out) {
  add_places(pool.known, pool.n_known, values, n, pool.patience_ms, out,
             [&](f64 value) { return first_declared_not_below(pool, value); });
}

PlaceSums plus(const PlaceSums& one, const PlaceSums& other, i64 sign) {
  const f64 by = static_cast<f64>(sign);
  return {one.size + sign * other.size, one.larger + by * other.larger,
          one.smaller + by * other.smaller, one.places + by * other.places};
}

// Deviations from chance by which values are larger, or smaller, than declared; the values are from
// a stretch of `cycles` cycles.
f64 deviations(const Pool& pool, const PlaceSums& sums, i64 cycles) {
  if (sums.size == 0) return 0.0;
  const f64 size = static_cast<f64>(sums.size);
  const f64 share = static_cast<f64>(pool.block) / static_cast<f64>(cycles);
  const f64 together = size * std::min(share, 1.0);
  // Wilson and Hilferty: the cube root of the mean of exponential values is almost normal.
  const f64 part = 1.0 / (9.0 * size);
  const f64 largest = std::max({sums.larger, sums.smaller, 0.0}) / size;
  const f64 off = (dwell::cube_root(largest) - (1.0 - part)) / std::sqrt(part);
  return off / std::sqrt(1.0 + std::max(together - 1.0, 0.0) * pool.likeness);
}

bool is_large(const PlaceSums& sums) {
  const f64 mean = sums.places / static_cast<f64>(sums.size);
  return !(1 - kMoved <= mean && mean <= kMoved);
}

// Moves the held rows to the begin of their room, if `more` rows do not fit behind them.
template <class Row>
void make_room(Row* rows, i64& first, i64 n, i64 more) {
  if (first + n + more <= kRoom) return;
  std::copy(rows + first, rows + first + n, rows);
  first = 0;
}

// Adds values, and drops the oldest windows: those beyond the memory, or to keep `kLargest` values.
void add(Pool& pool, const f64* values, const PlaceSums& shift, i64 window, f64 memory,
         i64 cycles) {
  make_room(pool.chunks, pool.first_chunk, pool.n_chunks, 1);
  Chunk* oldest = pool.chunks + pool.first_chunk;
  oldest[pool.n_chunks++] = {window, cycles, shift.size, shift.larger, shift.smaller, shift.places};
  pool.cycles += cycles;
  PlaceSums total = plus({pool.size, pool.larger, pool.smaller, pool.places}, shift, 1);
  const auto is_forgotten = [&](const Chunk& chunk) {
    return static_cast<f64>(chunk.window) <= static_cast<f64>(window) - memory &&
           total.size - chunk.size >= kEnough;
  };
  while (is_forgotten(*oldest) || total.size > kLargest) {
    total = plus(total, {oldest->size, oldest->larger, oldest->smaller, oldest->places}, -1);
    pool.cycles -= oldest->cycles;
    ++oldest;
    ++pool.first_chunk;
    --pool.n_chunks;
  }
  // The remaining old values, then the new values.
  const i64 kept = total.size - shift.size;
  pool.first += pool.size - kept;
  make_room(pool.held, pool.first, kept, shift.size);
  std::copy(values, values + shift.size, pool.held + pool.first + kept);
  pool.measured = std::min(pool.measured + shift.size, total.size);
  pool.size = total.size;
  ++pool.changes;
  pool.larger = total.larger;
  pool.smaller = total.smaller;
  pool.places = total.places;
  if (pool.is_declared == 0) pool.touched = window;
}

void set_run(Pool& pool, const PlaceSums& run, i64 cycles) {
  pool.run_cycles = is_large(run) ? cycles : 0;
  pool.run_size = run.size;
  pool.run_larger = run.larger;
  pool.run_smaller = run.smaller;
  pool.run_places = run.places;
}

PlaceSums run_of(const Pool& pool) {
  return {pool.run_size, pool.run_larger, pool.run_smaller, pool.run_places};
}

// Whether a window continues the run of larger, or smaller, windows; a run is at most a stretch.
bool run_goes_on(const Pool& pool, i64 cycles) {
  return pool.run_cycles > 0 && pool.run_cycles + cycles <= pool.block;
}

// Adds the values of a window to a pool that is not as declared, unless they resemble the declared
// values, or show another regime.
i64 learn_otherwise(Pool& pool, const f64* values, i64 n, i64 window, f64 memory, i64 cycles) {
  if (pool.doubts != 0 || pool.size > kLargest) return kNotAdded;
  PlaceSums declared, run;
  add_declared_places(pool, values, n, declared);
  if (deviations(pool, declared, cycles) < kAlike) return kNotAdded;
  const bool goes_on = run_goes_on(pool, cycles);
  if (!goes_on) {
    const f64* held = pool.held + pool.first;
    f64* end = std::copy(held, held + pool.size, pool.before);
    std::sort(pool.before, end, [](f64 one, f64 other) { return one < other; });
    pool.n_before = pool.size;
  }
  const bool is_after_declared = pool.n_before == 0;
  add_places(is_after_declared ? pool.known : pool.before,
             is_after_declared ? pool.n_known : pool.n_before, values, n,
             std::numeric_limits<f64>::infinity(), run);
  if (goes_on) run = plus(run_of(pool), run, 1);
  const i64 run_cycles = cycles + (goes_on ? pool.run_cycles : 0);
  if (is_large(run) && deviations(pool, run, run_cycles) >= kShifted) return kNotAdded;
  set_run(pool, run, run_cycles);
  pool.last = window;
  add(pool, values, declared, window, memory, cycles);
  return kGrown;
}

// Adds the values of a window to a pool, unless they show another regime; returns 0, or the reason
// why Python must look at the pool.
i64 learn(Pool& pool, const f64* values, i64 n, i64 window, f64 memory, i64 cycles, f64 least) {
  if (pool.n_known == 0 || pool.asks != 0 || n > kLargest) return kNotAdded;
  if (pool.is_declared == 0) return learn_otherwise(pool, values, n, window, memory, cycles);
  PlaceSums declared;
  add_declared_places(pool, values, n, declared);
  const bool goes_on = run_goes_on(pool, cycles);
  const PlaceSums run = goes_on ? plus(run_of(pool), declared, 1) : declared;
  const i64 run_cycles = cycles + (goes_on ? pool.run_cycles : 0);
  if (is_large(run) && deviations(pool, run, run_cycles) >= least) return kNotAdded;
  set_run(pool, run, run_cycles);
  pool.n_before = 0;
  pool.last = window;
  add(pool, values, declared, window, memory, cycles);
  const PlaceSums held = {pool.size, pool.larger, pool.smaller, pool.places};
  if (deviations(pool, held, std::max(pool.cycles, i64{1})) >= least) return kAdded;
  pool.lasting = 0;
  return 0;
}

}  // namespace
}  // namespace dwell

using namespace dwell;

// Writes the sums of the places of values among `n_known` ascending values; a value beyond the
// patience counts as lost.
DWELL_EXPORT void dwell_places(const f64* known, i64 n_known, const f64* values, i64 n,
                               f64 patience_ms, f64* out) noexcept {
  PlaceSums sums;
  add_places(known, n_known, values, n, patience_ms, sums);
  out[0] = sums.larger;
  out[1] = sums.smaller;
  out[2] = sums.places;
}

// Adds the values of a window to the pools of some parts. Writes for each part why Python must look
// at the pool, or 0; returns the number of these pools.
DWELL_EXPORT i64 dwell_learn(Pool* const* pools, const Found* found, const i64* parts, i64 n_parts,
                             i64 window, f64 memory, i64 cycles, f64 least, i64* out) noexcept {
  i64 n = 0;
  for (i64 i = 0; i < n_parts; ++i) {
    const i64 part = parts[i];
    const f64* values = found->ms + part * found->most;
    out[i] = learn(*pools[part], values, found->count[part], window, memory, cycles, least);
    n += out[i] != 0 ? 1 : 0;
  }
  return n;
}

// Writes the number of declared values below each part of their range, and below its end.
DWELL_EXPORT void dwell_guide(const f64* known, i64 n_known, f64 low, f64 parts_per_ms,
                              i32* out) noexcept {
  i64 part = 0;
  for (i64 i = 0; i < n_known; ++i) {
    for (; part <= part_of(known[i], low, parts_per_ms); ++part) out[part] = static_cast<i32>(i);
  }
  for (; part <= kGuideParts; ++part) out[part] = static_cast<i32>(n_known);
}

DWELL_EXPORT void dwell_pool_add(Pool* pool, const f64* values, i64 n, f64 larger, f64 smaller,
                                 f64 places, i64 window, f64 memory, i64 cycles) noexcept {
  add(*pool, values, {n, larger, smaller, places}, window, memory, cycles);
}

// Writes the numbers of the pools that are not as declared; returns their count.
DWELL_EXPORT i64 dwell_others(const Pool* const* pools, i64 n_pools, i64* out) noexcept {
  i64 n = 0;
  for (i64 i = 0; i < n_pools; ++i) {
    if (pools[i]->is_declared == 0) out[n++] = i;
  }
  return n;
}

// Writes for each row of parts, -1 for none, the fewest measured values of a part, and the earliest
// window of a part's newest values.
DWELL_EXPORT void dwell_weakest(const Pool* const* pools, const i64* parts, i64 n_rows, i64 width,
                                i64* out) noexcept {
  for (i64 row = 0; row < n_rows; ++row, out += 2) {
    out[0] = out[1] = std::numeric_limits<i64>::max();
    for (i64 i = 0; i < width; ++i) {
      const i64 part = parts[row * width + i];
      if (part < 0) continue;
      out[0] = std::min(out[0], pools[part]->measured);
      out[1] = std::min(out[1], pools[part]->last);
    }
  }
}

// Writes the times of runs from `first` on, nanoseconds, into every `rate`-th cycle: the finite
// values, repeated in turn from run 0. Returns the number of finite values.
DWELL_EXPORT i64 dwell_fill(const f64* values, i64 n, f64 stretched, i64 first, i64 count, i64 rate,
                            i64* out) noexcept {
  const i64 known = std::count_if(values, values + n, [](f64 ms) { return std::isfinite(ms); });
  if (known == 0) return 0;
  // First run of each known value.
  i64 at = (known - first % known) % known;
  for (i64 i = 0; i < n; ++i) {
    if (!std::isfinite(values[i])) continue;
    if (at < count) out[at * rate] = static_cast<i64>(std::rint(values[i] * 1e6 / stretched));
    at = at + 1 == known ? 0 : at + 1;
  }
  for (i64 i = known; i < count; ++i) out[i * rate] = out[(i - known) * rate];
  return known;
}
