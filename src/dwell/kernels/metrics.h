// The metrics of a window as it could be known when it closed: misses, L95, shares of resources.
#pragma once

#include <limits>

#include "windows.h"

namespace dwell {

// Rank of L95 among n values: ceil(0.95 n).
constexpr i64 l95_rank(i64 n) { return (19 * n + 19) / 20; }

// Whether a value at a rank, of ages among latencies, is that of a cycle that has not completed: of
// equal values those come last.
template <class S>
bool is_age(const S& s, const Cell& cell, i64 row, i64 first, i64 rank, i64 value, i64 now) {
  i64 before = 0;
  for (i64 i = 0; i < cell.window_cycles; ++i) {
    const i64 latency_ns = s.latency_ns[row + i];
    const i64 age_ns = now - cell.release_ns[first + i];
    before += std::min(latency_ns, age_ns) < value || (latency_ns == value && latency_ns <= age_ns);
  }
  return before < rank;
}

// Writes what the window that closes now shows.
template <class S>
void measure(S& s, i64 cell, i64 window, i64 first, i64 now) {
  const Cell& of = s.cell(cell);
  const i64 n = of.window_cycles, row = s.output(cell, first), rank = l95_rank(n);
  i64 missed = 0, unfinished = 0;
  for (i64 i = 0; i < n; ++i) {
    const i64 latency_ns = s.latency_ns[row + i];
    const i64 age_ns = now - of.release_ns[first + i];
    unfinished += latency_ns > age_ns;
    missed += latency_ns > std::min(age_ns, of.deadline_ns);
    s.ages[i] = std::min(latency_ns, age_ns);
  }
  i64* ages = s.ages.rows;
  std::nth_element(ages, ages + rank - 1, ages + n);
  const i64 l95_ns = ages[rank - 1];
  const f64 l95_ms = static_cast<f64>(l95_ns) / 1e6;
  const bool lost = unfinished > n - rank && is_age(s, of, row, first, rank, l95_ns, now);
  s.seen[cell * s.clock[0].n_windows + window] =
      Seen{first, missed, std::min(l95_ms, of.longest_ms),
           lost ? std::numeric_limits<f64>::infinity() : l95_ms};

  const i64 at = snapshot_row(s, cell, window), n_resources = s.clock[0].n_resources;
  const f64 span_ns = static_cast<f64>(now - of.release_ns[first]);
  for (i64 part = 0; part < kParts; ++part) {
    for (i64 i = 0; i < of.n_resources; ++i) {
      const i64 place = at + part * n_resources + i;
      const f64 used_ns = s.closed[place] - s.opened[place];
      s.shares[place] = std::min(used_ns / (s.capacity[of.resource_0 + i] * span_ns), 1.0);
    }
  }
}

// Closes a window; the next one follows without a gap unless the caller says otherwise.
template <class S>
[[gnu::noinline]] void close_window(S& s, i64 cell, i64 now) {
  Cell& of = s.cell(cell);
  snapshot(s, &s.closed[snapshot_row(s, cell, of.window)], cell, now);
  measure(s, cell, of.window, of.close_cycle - of.window_cycles, now);
  s.clock[0].closed_cell = cell;
  of.close_pending = 0;
  of.window += 1;
  of.window_first = of.close_cycle;
  of.close_cycle += of.window_cycles;
}

}  // namespace dwell
