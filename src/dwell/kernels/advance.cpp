// Functions of the event loop for Python.

#include "advance.h"

#include "export.h"

namespace dwell {
namespace {

template <bool has_quotas, bool is_plain, bool has_rates>
Status advance(const Tables& tables) {
  Simulation<has_quotas, is_plain, has_rates> simulation(tables);
  const Status status = play(simulation);
  simulation.queue.save(tables.clock[0]);
  return status;
}

// Cells with several rates are simulated as if they had quotas: two instances fewer.
template <bool is_plain>
Status advance(const Tables& tables) {
  if (tables.clock[0].has_rates) return advance<true, is_plain, true>(tables);
  return tables.quotas.size > 0 ? advance<true, is_plain, false>(tables)
                                : advance<false, is_plain, false>(tables);
}

// Marks the instants of tasks and flows that do not run in a cycle as not due.
template <class S>
void mark_undue(const S& s, i64 cell, i64 cycle, i64 n_tasks, const i64* flows, i64 n_flows,
                i64* ready_ns) {
  i64 *end_ns = ready_ns + n_tasks, *arrived_ns = end_ns + n_tasks;
  i64 *work_ns = arrived_ns + n_flows, *start_ns = work_ns + n_tasks;
  for (i64 task = 0; task < n_tasks; ++task) {
    if (s.is_due(s.task(cell, task), cycle)) continue;
    ready_ns[task] = end_ns[task] = work_ns[task] = start_ns[task] = kNotDue;
  }
  for (i64 i = 0; i < n_flows; ++i) {
    if (!s.is_due(s.flow(cell, flows[i]), cycle)) arrived_ns[i] = kNotDue;
  }
}

// Instant at which the node of a task hears that a cycle is done; `kLastNs` for never.
template <class S>
i64 heard_ns(const S& s, i64 cell, i64 cycle, i64 task) {
  const i64 row = (s.cell(cell).candidate_0 + s.stamp(cell, cycle)) * s.n_tasks;
  const i64 done_ns = s.cell(cell).release_ns[cycle] + s.latency_ns[s.output(cell, cycle)];
  const i64 node = s.sites[s.site_of[row + task]].node;
  for (i64 first = 0; first < s.n_tasks; ++first) {
    const i32 site = s.site_of[row + first];
    const bool is_heard = site >= 0 && s.sites[site].node == node && s.hear_ns[row + first] >= 0;
    if (is_heard) return later(done_ns, s.hear_ns[row + first]);
  }
  return kLastNs;
}

// Whether the message of a flow has arrived in any of some cycles.
template <class S>
bool has_arrived(const S& s, i64 cell, i64 begin, i64 end, i64 flow) {
  for (i64 cycle = begin; cycle < end; ++cycle) {
    if (s.log_arrived[s.log_row(cell, cycle) * s.n_flows + flow] >= 0) return true;
  }
  return false;
}

// Instant from which the message of a flow may be sent, if its sender completes at `end_ns`.
template <class S>
i64 sent_ns(const S& s, i64 cell, i64 cycle, i64 flow, i64 end_ns) {
  const i64 candidate = s.cell(cell).candidate_0 + s.stamp(cell, cycle);
  const i64 source = s.flow(cell, flow).source;
  const bool is_held =
      flow >= s.cell(cell).flow_copies && s.site_of[candidate * s.n_tasks + source] < 0;
  const i64 due_ns = later(s.cell(cell).release_ns[cycle], s.after_ns[candidate]);
  return is_held && end_ns < due_ns ? due_ns : end_ns - 1;
}

// Marks what was cancelled in a cycle with replicas that is done: it shows no loss. A message that
// could be repeated was cancelled if one of a later cycle before `end` has arrived.
template <class S>
void mark_cancelled(const S& s, i64 cell, i64 cycle, i64 end, i64 n_tasks, const i64* flows,
                    i64 n_flows, i64* ready_ns) {
  const i64 candidate = s.cell(cell).candidate_0 + s.stamp(cell, cycle);
  if (s.after_ns[candidate] < 0 || s.outcome[s.output(cell, cycle)] != kDone) return;
  i64 *end_ns = ready_ns + n_tasks, *arrived_ns = end_ns + n_tasks;
  i64 *work_ns = arrived_ns + n_flows, *start_ns = work_ns + n_tasks;
  const i64 copies = s.cell(cell).copies;
  for (i64 i = 0; i < n_flows; ++i) {
    if (arrived_ns[i] >= 0) continue;
    i64 source = s.flow(cell, flows[i]).source;
    if (s.site_of[candidate * s.n_tasks + source] < 0) source -= copies;
    const i32 hop = s.route[candidate * s.n_flows + flows[i]];
    const bool may_repeat = hop < 0 || s.links[s.hops[hop].link].retransmit_ns >= 0;
    const i64 from_ns = sent_ns(s, cell, cycle, flows[i], end_ns[source]);
    if (from_ns >= heard_ns(s, cell, cycle, source) ||
        (may_repeat && has_arrived(s, cell, cycle + 1, end, flows[i]))) {
      arrived_ns[i] = kNotDue;
    }
  }
  for (i64 task = 0; task < n_tasks; ++task) {
    const bool is_lost = s.log_outcome[s.log_entry(cell, cycle, task)] != kInFlight;
    if (end_ns[task] >= 0 || (ready_ns[task] >= 0 && is_lost)) continue;
    ready_ns[task] = end_ns[task] = work_ns[task] = start_ns[task] = kNotDue;
  }
}

}  // namespace
}  // namespace dwell

using namespace dwell;

// Continues a simulation; returns a Status.
DWELL_EXPORT i32 dwell_advance(const Tables* tables) noexcept {
  const bool is_plain = tables->cells.size == 1 && tables->log.size == 0;
  return is_plain ? advance<true>(*tables) : advance<false>(*tables);
}

// Adds an event of the caller; the queue must have room.
DWELL_EXPORT void dwell_post_event(const Tables* tables, i64 at_ns, i64 key) noexcept {
  Queue queue(tables->events, tables->following, tables->days, tables->clock[0]);
  queue.push(at_ns, key);
  queue.save(tables->clock[0]);
}

// Writes the logs of cycles and of their shadows as rows of a `Window`. If cells share servers,
// writes two integrals per job into `beside` (see `Log`).
DWELL_EXPORT void dwell_logged_window(const Tables* tables, i64 cell_0, i64 n_cells, i64 first,
                                      i64 n, i64 n_tasks, const i64* flows, i64 n_flows, i64* out,
                                      i64* beside) noexcept {
  const Simulation<false, false, true> s(*tables);
  for (i64 cycle = first; cycle < first + n; ++cycle) {
    for (i64 cell = cell_0; cell < cell_0 + n_cells; ++cell) {
      const i64 row = s.log_row(cell, cycle);
      *out++ = s.stamp(cell, cycle);
      i64 *ready_ns = out, *end_ns = ready_ns + n_tasks, *arrived_ns = end_ns + n_tasks;
      i64 *work_ns = arrived_ns + n_flows, *start_ns = work_ns + n_tasks;
      for (i64 task = 0; task < n_tasks; ++task) {
        const i64 at = row * s.n_tasks + task;
        ready_ns[task] = s.log[at].ready_ns;
        end_ns[task] = s.log_outcome[at] == kDone ? s.log[at].end_ns : -1;
        work_ns[task] = s.log[at].work_ns;
        start_ns[task] = s.log[at].start_ns;
        if (beside == nullptr) continue;
        beside[0] = s.log[at].used_ns;
        beside[1] = s.log[at].above_ns;
        beside += 2;
      }
      for (i64 i = 0; i < n_flows; ++i) arrived_ns[i] = s.log_arrived[row * s.n_flows + flows[i]];
      if (tables->clock[0].has_rates) {
        mark_undue(s, cell, cycle, n_tasks, flows, n_flows, out);
        if (cell == cell_0) {
          mark_cancelled(s, cell, cycle, first + n, n_tasks, flows, n_flows, out);
        }
      }
      out = start_ns + n_tasks;
    }
  }
}

// Attempts to send the state of a task that moves (see send_state). `key` is the event of its
// arrival; `out` is the instant of the next attempt, -1 for none, and its number. The queue must
// have room.
DWELL_EXPORT void dwell_send_state(const Tables* tables, i64 hop, i64 cycle, i64 attempt, i64 key,
                                   i64 now, i64* out) noexcept {
  Simulation<true, false, true> simulation(*tables);
  const StateAttempt next = send_state(simulation, hop, cycle, attempt, key, now);
  simulation.queue.save(tables->clock[0]);
  out[0] = next.at_ns;
  out[1] = next.number;
}

// Releases the messages that wait for state that is not sent again.
DWELL_EXPORT void dwell_end_repeats(const Tables* tables, i64 key, i64 now) noexcept {
  Simulation<true, false, true> simulation(*tables);
  end_repeats(simulation, key, now);
  simulation.queue.save(tables->clock[0]);
}
