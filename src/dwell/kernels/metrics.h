// Metrics of a window as known at its end: misses, L95, shares of resources.
#pragma once

#include <limits>

#include "chains.h"
#include "windows.h"

namespace dwell {

constexpr f64 kHourNs = 3.6e12;

// Rank of L95 among n values: ceil(0.95 n).
constexpr i64 l95_rank(i64 n) { return (19 * n + 19) / 20; }

// L95 of the data ages of a window's actuations up to now, in place of L95 of latencies.
template <class S>
[[gnu::noinline]] void measure_chain(S& s, i64 cell, i64 now, Seen& seen) {
  const Cell& of = s.cell(cell);
  const i64 row = s.actuation(cell, of.latency_chain, seen.first_cycle);
  i64 known = 0;
  for (i64 i = 0; i < seen.cycles; ++i) {
    const i64 at_ns = s.actuated_ns[row + i];
    if (at_ns <= now) s.ages[known++] = at_ns - of.release_ns[s.actuated_from[row + i]];
  }
  seen.uncut_ms = std::numeric_limits<f64>::infinity();
  if (known > 0) {
    i64* ages = s.ages.rows;
    const i64 rank = l95_rank(known);
    std::nth_element(ages, ages + rank - 1, ages + known);
    seen.uncut_ms = static_cast<f64>(ages[rank - 1]) / 1e6;
  }
  seen.l95_ms = std::min(seen.uncut_ms, of.longest_ms);
}

// Integral of an age that grows from `from` to `until`, each at most `most`.
inline f64 age_area(f64 from, f64 until, f64 most) {
  const f64 turn = std::clamp(most, from, until);
  return (from + turn) / 2 * (turn - from) + most * (until - turn);
}

// Mean over time, from the release of a cycle until now, of the age of the newest command, ms: of
// the chain that counts as latency, else of cycles. A command that a newer one overtook has no
// effect. Walks back from the newest cycle.
template <class S>
[[gnu::noinline]] f64 mean_age_ms(const S& s, i64 cell, i64 first, i64 now) {
  const Cell& of = s.cell(cell);
  const bool of_chain = S::kRates && of.latency_chain >= 0;
  const f64 most_ns = of.longest_ms * 1e6;
  const i64 begin_ns = of.release_ns[first];
  const auto add = [&](i64 from_ns, i64 until_ns, i64 origin) {
    const i64 born_ns = of.release_ns[origin];
    return age_area(static_cast<f64>(from_ns - born_ns), static_cast<f64>(until_ns - born_ns),
                    most_ns);
  };
  f64 area = 0.0;
  i64 until_ns = now, cycle = of.released - 1;
  for (; cycle >= 0 && until_ns > begin_ns; --cycle) {
    // A cycle whose place another has taken had ended by then. All older commands, too, count with
    // the largest age. Until its end a cycle may take a value that is newer than itself.
    const i64 ended = of_chain ? cycle + s.n_slots : cycle;
    if (ended < of.released && static_cast<f64>(begin_ns - of.release_ns[ended]) >= most_ns) break;
    const i64 row = of_chain ? s.actuation(cell, of.latency_chain, cycle) : s.output(cell, cycle);
    const i64 at_ns =
        of_chain ? s.actuated_ns[row] : later(of.release_ns[cycle], s.latency_ns[row]);
    if (at_ns >= until_ns) continue;
    const i64 from_ns = std::max(at_ns, begin_ns);
    area += add(from_ns, until_ns, of_chain ? s.actuated_from[row] : cycle);
    until_ns = from_ns;
  }
  if (until_ns > begin_ns) area += add(begin_ns, until_ns, 0);
  return area / static_cast<f64>(now - begin_ns) / 1e6;
}

// Whether the value at the rank of L95 is the age of an unfinished cycle; between equal values,
// latencies precede ages.
template <class S>
bool is_age(const S& s, i64 cell, i64 first, i64 n, i64 rank, i64 value, i64 now) {
  const Cell& of = s.cell(cell);
  const i64 row = s.output(cell, first);
  i64 before = 0;
  for (i64 i = 0; i < n; ++i) {
    if (S::kRates && s.outcome[row + i] == kIdle) continue;
    const i64 latency_ns = s.latency_ns[row + i];
    const i64 age_ns = now - of.release_ns[first + i];
    before += std::min(latency_ns, age_ns) < value || (latency_ns == value && latency_ns <= age_ns);
  }
  return before < rank;
}

// Misses and L95 of `n` cycles as known now.
template <class S>
[[gnu::noinline]] Seen measure_cycles(S& s, i64 cell, i64 first, i64 n, i64 now) {
  const Cell& of = s.cell(cell);
  const i64 row = s.output(cell, first);
  i64 missed = 0, unfinished = 0, counted = 0;
  for (i64 i = 0; i < n; ++i) {
    if (S::kRates && s.outcome[row + i] == kIdle) continue;
    const i64 latency_ns = s.latency_ns[row + i];
    const i64 age_ns = now - of.release_ns[first + i];
    unfinished += latency_ns > age_ns;
    missed += latency_ns > std::min(age_ns, of.deadline_ns) ||
              (S::kRates && is_over_age(s, cell, first + i, now));
    s.ages[S::kRates ? counted++ : i] = std::min(latency_ns, age_ns);
  }
  if (!S::kRates) counted = n;
  if (counted == 0) return Seen{first, n, 0, 0, 0.0, 0.0, 0.0, 0.0};
  const i64 rank = l95_rank(counted);
  i64* ages = s.ages.rows;
  std::nth_element(ages, ages + rank - 1, ages + counted);
  const i64 l95_ns = ages[rank - 1];
  const f64 l95_ms = static_cast<f64>(l95_ns) / 1e6;
  const bool lost = unfinished > counted - rank && is_age(s, cell, first, n, rank, l95_ns, now);
  return Seen{first,
              n,
              missed,
              counted,
              std::min(l95_ms, of.longest_ms),
              lost ? std::numeric_limits<f64>::infinity() : l95_ms,
              0.0,
              0.0};
}

// Metrics of `n` cycles as known now.
template <class S>
Seen measure(S& s, i64 cell, i64 first, i64 n, i64 now) {
  const Cell& of = s.cell(cell);
  Seen seen = measure_cycles(s, cell, first, n, now);
  if (S::kRates && of.latency_chain >= 0) measure_chain(s, cell, now, seen);
  if (of.weighs_age != 0) seen.age_ms = mean_age_ms(s, cell, first, now);
  if (s.paid.size > 0) {
    const f64 paid = of.paid - s.paid[s.output(cell, first)];
    seen.price_per_hour = paid * kHourNs / static_cast<f64>(now - of.release_ns[first]);
  }
  return seen;
}

// Writes the used share of each resource from the release of a cycle until now.
template <class S>
void measure_shares(const S& s, i64 cell, const f64* opened, const f64* closed, i64 first, i64 now,
                    f64* shares) {
  const Cell& of = s.cell(cell);
  const f64 span_ns = static_cast<f64>(now - of.release_ns[first]);
  for (i64 part = 0; part < kParts; ++part) {
    for (i64 i = 0; i < of.n_resources; ++i) {
      const i64 place = part * s.clock[0].n_resources + i;
      const f64 used_ns = closed[place] - opened[place];
      shares[place] = std::min(used_ns / (s.capacity[of.resource_0 + i] * span_ns), 1.0);
    }
  }
}

// Ends a window; the next window follows without a gap unless the caller changes it.
template <class S>
[[gnu::noinline]] void close_window(S& s, i64 cell, i64 now) {
  Cell& of = s.cell(cell);
  const i64 first = of.close_cycle - of.window_cycles, row = snapshot_row(s, cell, of.window);
  snapshot(s, &s.closed[row], cell, now);
  s.seen[cell * s.clock[0].n_windows + of.window] = measure(s, cell, first, of.window_cycles, now);
  measure_shares(s, cell, &s.opened[row], &s.closed[row], first, now, &s.shares[row]);
  s.clock[0].closed_cell = cell;
  of.close_pending = 0;
  of.window += 1;
  of.window_first = of.close_cycle;
  of.close_cycle += of.window_cycles;
}

// Measures the cycles for a decision: the last W under the placement in force, or fewer.
template <class S>
[[gnu::noinline]] void look(S& s, i64 cell, i64 now) {
  Cell& of = s.cell(cell);
  const i64 end = of.look_cycle, n = std::min(of.window_cycles, end - of.since);
  const i64 stretch = look_row(s, cell, of.look, 0), row = look_row(s, cell, of.look, 1);
  const i64 opened = end - n == of.since ? look_row(s, cell, of.look_0, 0) : row;
  const f64* closed = &s.look_closed[look_end_row(s, cell, of.look)];
  snapshot(s, &s.look_closed[look_end_row(s, cell, of.look)], cell, now);
  s.looked[cell * s.clock[0].n_looks + of.look] = measure(s, cell, end - n, n, now);
  measure_shares(s, cell, &s.look_opened[stretch], closed, end - of.decide_cycles, now,
                 &s.look_shares[stretch]);
  measure_shares(s, cell, &s.look_opened[opened], closed, end - n, now, &s.look_shares[row]);
  s.clock[0].closed_cell = cell;
  of.look_pending = 0;
  of.look += 1;
  of.look_cycle += of.decide_cycles;
}

}  // namespace dwell
