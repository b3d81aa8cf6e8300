// The state of a simulation during one call: its tables, its queue, and the work of one event.
#pragma once

#include "codes.h"
#include "instants.h"
#include "queue.h"
#include "rows.h"

namespace dwell {

// Features are constants at compile time, and unused features cost no time. `kQuotas`: some node
// has a quota. `kPlain`: the simulation has one cell without a shadow, and logs no jobs. `kRates`:
// some tasks skip cycles, or some flows are sampled.
template <bool has_quotas, bool is_plain, bool has_rates>
struct Simulation : Tables {
  static constexpr bool kQuotas = has_quotas;
  static constexpr bool kPlain = is_plain;
  static constexpr bool kRates = has_rates;

  Queue queue;
  const i64 n_slots, n_tasks, n_flows, n_cycles;
  i64 n_dirty = 0;
  i64 n_ready = 0;

  explicit Simulation(const Tables& tables)
      : Tables(tables),
        queue(events, following, days, clock[0]),
        n_slots(clock[0].n_slots),
        n_tasks(clock[0].n_tasks),
        n_flows(clock[0].n_flows),
        n_cycles(clock[0].n_cycles) {}

  void post(i64 at_ns, i64 key) { queue.push(at_ns, key); }

  Cell& cell(i64 cell) const { return cells[kPlain ? 0 : cell]; }

  // Places in the ring of the cycles in flight.
  i64 slot_row(i64 cell, i64 cycle) const {
    return (kPlain ? 0 : cell * n_slots) + (cycle & (n_slots - 1));
  }
  Slot& slot(i64 cell, i64 cycle) const { return slots[slot_row(cell, cycle)]; }
  Job& job(i64 cell, i64 cycle, i64 task) const {
    return jobs[slot_row(cell, cycle) * n_tasks + task];
  }
  Job& job(i64 key) const { return job(cell_of(key), cycle_of(key), item_of(key)); }
  Site& site(const Job& job) const { return sites[job.site]; }
  Server& server(const Site& site) const { return servers[site.server]; }
  Task& task(i64 cell, i64 local) const { return tasks[(kPlain ? 0 : cells[cell].task_0) + local]; }
  Flow& flow(i64 cell, i64 local) const { return flows[(kPlain ? 0 : cells[cell].flow_0) + local]; }

  // Whether a task runs in a cycle, or a flow carries a message in it.
  template <class Row>
  static bool is_due(const Row& row, i64 cycle) {
    // 32 bits hold every cycle, and their division is faster.
    return !kRates || static_cast<u32>(cycle) % static_cast<u32>(row.every) == 0;
  }

  // Place of a cycle in the outputs.
  i64 output(i64 cell, i64 cycle) const { return (kPlain ? 0 : cell * n_cycles) + cycle; }
  i16& stamp(i64 cell, i64 cycle) const { return stamps[output(cell, cycle)]; }

  // Cycles of a chain's first task from which a job descends.
  Descent& descent(i64 cell, i64 cycle, i64 task, i64 chain) const {
    return descents[(output(cell, cycle) * n_tasks + task) * clock[0].n_chains + chain];
  }

  // Place of a cycle in the actuations of a chain.
  i64 actuation(i64 cell, i64 chain, i64 cycle) const {
    return ((kPlain ? 0 : cell * clock[0].n_chains) + chain) * n_cycles + cycle;
  }

  // Place of a cycle in the logs.
  i64 log_row(i64 cell, i64 cycle) const {
    return clock[0].logs_all ? output(cell, cycle) : slot_row(cell, cycle);
  }

  i64 log_entry(i64 cell, i64 cycle, i64 task) const {
    return log_row(cell, cycle) * n_tasks + task;
  }

  // Prefetches the values of the next cycles, given a value of this cycle. With many cells the
  // processor's own prefetching is too late.
  template <class T>
  static void fetch_next(const T& value) {
    constexpr i64 kLineBytes = 64, kValues = kLineBytes / static_cast<i64>(sizeof(T));
    if constexpr (!kPlain) __builtin_prefetch(&value + kValues);
  }

  // Hop of a flow in a cycle, -1 on the same node.
  i64 hop(i64 cell, i64 cycle, i64 flow) const {
    return route[slot(cell, cycle).candidate * n_flows + flow];
  }
};

}  // namespace dwell
