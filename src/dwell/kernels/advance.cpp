// What Python calls of the event loop.

#include "advance.h"

#include "export.h"

namespace dwell {
namespace {

template <bool has_quotas, bool is_plain>
Status advance(const Tables& tables) {
  Simulation<has_quotas, is_plain> simulation(tables);
  const Status status = play(simulation);
  simulation.queue.save(tables.clock[0]);
  return status;
}

}  // namespace
}  // namespace dwell

using namespace dwell;

// Plays a simulation on; returns a Status.
DWELL_EXPORT i32 dwell_advance(const Tables* tables) noexcept {
  const bool is_plain = tables->cells.size == 1 && tables->log.size == 0;
  if (tables->quotas.size > 0) {
    return is_plain ? advance<true, true>(*tables) : advance<true, false>(*tables);
  }
  return is_plain ? advance<false, true>(*tables) : advance<false, false>(*tables);
}

// Adds an event of the caller's; there must be room.
DWELL_EXPORT void dwell_post_event(const Tables* tables, i64 at_ns, i64 key) noexcept {
  Queue queue(tables->events, tables->following, tables->days, tables->clock[0]);
  queue.push(at_ns, key);
  queue.save(tables->clock[0]);
}

// Copies what the logs have of `n` cycles, cell after cell, and in it one table after another: when
// jobs became ready, when they completed, when they started and the core time that they took, (n,
// tasks), and when the messages of `n_flows` flows arrived, (n, n_flows); -1 for never.
DWELL_EXPORT void dwell_logged_instants(const Tables* tables, i64 cell_0, i64 n_cells, i64 first,
                                        i64 n, const i64* flows, i64 n_flows, i64* out) noexcept {
  const Simulation<false, false> s(*tables);
  for (i64 cell = cell_0; cell < cell_0 + n_cells; ++cell) {
    const i64 jobs = n * s.n_tasks;
    i64 *ready_ns = out, *end_ns = ready_ns + jobs, *start_ns = end_ns + jobs;
    i64 *work_ns = start_ns + jobs, *arrived_ns = work_ns + jobs;
    for (i64 cycle = first; cycle < first + n; ++cycle) {
      const i64 row = s.log_row(cell, cycle);
      for (i64 at = row * s.n_tasks; at < (row + 1) * s.n_tasks; ++at) {
        *ready_ns++ = s.log[at].ready_ns;
        *end_ns++ = s.log_outcome[at] == kDone ? s.log[at].end_ns : -1;
        *start_ns++ = s.log[at].start_ns;
        *work_ns++ = s.log[at].work_ns;
      }
      for (i64 i = 0; i < n_flows; ++i) *arrived_ns++ = s.log_arrived[row * s.n_flows + flows[i]];
    }
    out = arrived_ns;
  }
}

// Sends the state of a task that moves (see send_state); `key` is the event of its arrival, `out`
// the instant of the next attempt, -1 for none, and its number. There must be room.
DWELL_EXPORT void dwell_send_state(const Tables* tables, i64 hop, i64 cycle, i64 attempt, i64 key,
                                   i64 now, i64* out) noexcept {
  Simulation<true, false> simulation(*tables);
  const StateAttempt next = send_state(simulation, hop, cycle, attempt, key, now);
  simulation.queue.save(tables->clock[0]);
  out[0] = next.at_ns;
  out[1] = next.number;
}

// Lets other messages wait no longer for state that is not sent again.
DWELL_EXPORT void dwell_end_repeats(const Tables* tables, i64 key, i64 now) noexcept {
  Simulation<true, false> simulation(*tables);
  end_repeats(simulation, key, now);
  simulation.queue.save(tables->clock[0]);
}
