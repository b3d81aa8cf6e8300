// Windows: the use of resources at the begin and end of each; and wakes of the guard.
#pragma once

#include "changes.h"

namespace dwell {

// Counters of core-nanoseconds per resource: busy, own jobs of the cell, its shadow's jobs, and
// jobs of other cells that share the resource, with their shadows.
constexpr i64 kParts = 4;

// Core-nanoseconds of a server that all cells and their shadows have used up to now.
template <class S>
f64 of_all_cells(S& s, Server& server, i64 row) {
  const i64 n_resources = s.clock[0].n_resources;
  f64 sum = 0.0;
  for (i64 cell = 0; cell < s.cells.size; ++cell) {
    const Cell& of = s.cell(cell);
    for (i64 i = 0; i < of.n_resources; ++i) {
      if (s.cell_servers[of.resource_0 + i] == row) sum += s.own_ns[cell * n_resources + i];
    }
  }
  for (i64 at = 0; at < server.n_run + server.n_wait; ++at) {
    const Progress found = progress(s, server, at);
    if (found.key != kForeign) sum += found.received_ns;
  }
  if (!has_below(s, server)) return sum;
  const Server& below = s.servers[server.below];
  for (i64 at = 0; at < below.n_run + below.n_wait; ++at) {
    const Progress found = progress(s, below, at);
    if (found.key != kForeign) sum += found.received_ns;
  }
  return sum;
}

// Writes the core-nanoseconds of a cell's resources up to now, in `kParts` parts; an accelerator
// counts place-nanoseconds.
template <class S>
[[gnu::noinline]] void snapshot(S& s, f64* out, i64 cell, i64 now) {
  const Cell& of = s.cell(cell);
  const i64 n_resources = s.clock[0].n_resources;
  for (i64 i = 0; i < of.n_resources; ++i) {
    Server& server = s.servers[s.cell_servers[of.resource_0 + i]];
    tick(s, server, now);
    f64 own = s.own_ns[cell * n_resources + i];
    for (i64 at = 0; at < server.n_run + server.n_wait; ++at) {
      const Progress found = progress(s, server, at);
      if (found.key != kForeign && cell_of(found.key) == cell) own += found.received_ns;
    }
    out[i] = server.busy_ns + server.behind_ns;
    out[n_resources + i] = own;
    if (has_below(s, server)) {
      Server& below = s.servers[server.below];
      tick(s, below, now);
      out[i] += below.busy_ns + below.behind_ns;
      if (of.shadow >= 0) {
        f64 extra = s.own_ns[of.shadow * n_resources + i];
        for (i64 at = 0; at < below.n_run + below.n_wait; ++at) {
          const Progress found = progress(s, below, at);
          if (cell_of(found.key) == of.shadow) extra += found.received_ns;
        }
        out[2 * n_resources + i] = extra;
      }
    }
    if (s.clock[0].has_shared) {
      const f64 mine = own + out[2 * n_resources + i];
      out[3 * n_resources + i] =
          std::max(of_all_cells(s, server, s.cell_servers[of.resource_0 + i]) - mine, 0.0);
    }
  }
}

// Place of a snapshot in `opened` and `closed`.
inline i64 snapshot_row(const Tables& s, i64 cell, i64 window) {
  return (cell * s.clock[0].n_windows + window) * kParts * s.clock[0].n_resources;
}

// Window that begins with a cycle, as known so far; -1 for none.
inline i64 opens(const Cell& cell, i64 cycle) {
  const i64 beyond = cycle - cell.close_cycle;
  if (beyond < 0) return cycle == cell.window_first ? cell.window : -1;
  // The previous window has not ended yet.
  return beyond % cell.window_cycles == 0 ? cell.window + 1 + beyond / cell.window_cycles : -1;
}

// Place of a snapshot in `look_opened` and `look_shares`: `part` 0 since the last decision, 1 over
// the cycles that a decision looks at.
inline i64 look_row(const Tables& s, i64 cell, i64 look, i64 part) {
  return ((cell * s.clock[0].n_looks + look) * 2 + part) * kParts * s.clock[0].n_resources;
}

// Place of a snapshot in `look_closed`.
inline i64 look_end_row(const Tables& s, i64 cell, i64 look) {
  return (cell * s.clock[0].n_looks + look) * kParts * s.clock[0].n_resources;
}

// Takes the snapshots of all decisions whose cycles begin with this cycle.
template <class S>
[[gnu::noinline]] void open_looks(S& s, i64 cell, i64 cycle, i64 now) {
  const Cell& of = s.cell(cell);
  const i64 every = of.decide_cycles, age = cycle - of.since;
  if (age < 0) return;
  // The cycle may begin the stretch up to a decision, or the W cycles that a decision looks at.
  const i64 begun[] = {age, age + of.window_cycles - every};
  for (i64 part = 0; part < 2; ++part) {
    const i64 look = of.look_0 + begun[part] / every;
    if (begun[part] % every != 0 || look >= s.clock[0].n_looks) continue;
    snapshot(s, &s.look_opened[look_row(s, cell, look, part)], cell, now);
  }
}

// Opens the window that begins with a cycle, if any.
template <class S>
void open_window(S& s, i64 cell, i64 cycle, i64 now) {
  const i64 window = opens(s.cell(cell), cycle);
  if (0 <= window && window < s.clock[0].n_windows) {
    snapshot(s, &s.opened[snapshot_row(s, cell, window)], cell, now);
  }
}

// End of the window whose last cycle is `cycle`.
inline i64 close_ns(const Cell& cell, i64 cycle) {
  return std::max(cell.release_ns[cycle + 1] + cell.grace_ns, cell.release_ns[cycle] + cell.due_ns);
}

// Announces the next end of a window of a cell; returns whether the cell waits for it, or migrates.
template <class S>
bool announce_close(S& s, i64 cell) {
  Cell& of = s.cell(cell);
  if (!of.close_pending && of.close_cycle <= of.n_cycles) {
    of.close_pending = 1;
    s.post(close_ns(of, of.close_cycle - 1), make_key(kClose, cell, of.close_cycle, 0));
  }
  return of.close_pending || of.migrating;
}

// Announces a cell's next decision, if decisions are more frequent than windows.
template <class S>
void announce_look(S& s, i64 cell) {
  Cell& of = s.cell(cell);
  if (of.decide_cycles == 0 || of.look_pending || of.look_cycle > of.n_cycles) return;
  of.look_pending = 1;
  s.post(close_ns(of, of.look_cycle - 1), make_key(kDecide, cell, of.look_cycle, 0));
}

// Whether the guard wakes now: it has learnt of no completion from cycle `waited` on, or the cycle
// after the newest known completion is as old as the patience, or the patience for a chain may have
// ended. If not, the check is repeated when that cycle is that old, or for the chain.
template <class S>
bool wakes_guard(S& s, i64 cell, i64 now) {
  Cell& of = s.cell(cell);
  // The guard has changed the time of its wake.
  if (of.wakes_ns != now) return false;
  of.wakes_ns = -1;
  if (of.chain_due_ns <= now) return true;
  const i64 waited = of.waited;
  for (i64 cycle = waited; cycle < of.n_cycles && of.release_ns[cycle] < now; ++cycle) {
    const i64 row = s.output(cell, cycle);
    if (s.outcome[row] != kDone) continue;
    const i64 back_ns = s.back_ns[of.candidate_0 + s.stamps[row]];
    if (later(of.release_ns[cycle] + s.latency_ns[row], back_ns) <= now) {
      of.waited = cycle + 1;
    }
  }
  if (of.waited == waited) return true;
  i64 due = of.chain_due_ns;
  if (of.waited < of.n_cycles) {
    due = std::min(due, later(of.release_ns[of.waited], of.patience_ns));
  }
  if (due <= now) return true;
  if (due >= kLastNs) return false;
  of.wakes_ns = due;
  s.post(due, make_key(kGuard, cell, 0, 0));
  return false;
}

}  // namespace dwell
