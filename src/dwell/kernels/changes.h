// Changes of nodes: the number of foreign threads; a node that goes down, loses its work, and
// recovers.
#pragma once

#include "cycles.h"

namespace dwell {

// More inputs than any task has: a join that can never be complete.
constexpr i32 kNever = 1 << 30;

// A job on a server, and the core-nanoseconds that it has received so far.
struct Progress {
  i64 key;  // kForeign for a foreign thread
  f64 received_ns;
};

// Progress of job `at` of a server: running jobs first, then jobs that wait for cores.
template <class S>
Progress progress(const S& s, const Server& server, i64 at) {
  i64 key;
  f64 left;
  if (at < server.n_run) {
    const Running& row = running_of(s, server)[at];
    key = row.key;
    left = row.finish_ns - server.virtual_ns;
  } else {
    const Waiting& row = waiting_of(s, server)[at - server.n_run];
    key = row.key;
    left = row.left_ns;
    if (key == kForeign) return {kForeign, 0.0};
  }
  const Job& job = s.job(key);
  const Site& site = s.site(job);
  left = std::max(left, 0.0);
  const f64 alone = time_alone(site, site.exec_ns[cycle_of(key)]);
  return {key, static_cast<f64>(site.need) * (alone - left)};
}

// Loses the jobs that run or wait for cores on a server whose node goes down.
template <class S>
[[gnu::noinline]] void crash(S& s, Server& server, i64 now) {
  for (i64 i = 0; i < server.n_run + server.n_wait; ++i) {
    const Progress found = progress(s, server, i);
    if (found.key == kForeign) continue;
    s.own_ns[s.site(s.job(found.key)).own] += found.received_ns;
    drop_job(s, cell_of(found.key), cycle_of(found.key), item_of(found.key), kNodeDown, now);
  }
  while (server.n_run > 0) {
    const i64 key = running_of(s, server)->key;
    leave(s, server, s.site(s.job(key)), key, now);
  }
  server.n_wait = 0;
  // Jobs that wait for their turn count, too.
  server.used = 0;
}

// Loses the inputs that wait on a node for the other inputs of their join.
template <class S>
[[gnu::noinline]] void lose_joins(S& s, i64 node) {
  for (i64 row = 0; row < s.slots.size; ++row) {
    const i64 cell = row / s.n_slots;
    const Slot& slot = s.slots[row];
    // A shadow with no job or message in flight may still wait for tasks shared with its parent.
    if (slot.live == 0 && s.cell(cell).parent < 0) continue;
    for (i64 task = 0; task < s.cell(cell).n_tasks; ++task) {
      Job& job = s.jobs[row * s.n_tasks + task];
      const bool waits = 0 < job.missing && job.missing < s.task(cell, task).n_in;
      if (waits && s.site(job).node == node) {
        lose(s, cell, slot.cycle, task, kNodeDown);
        if (!await_again(s, cell, slot.cycle, task)) job.missing = kNever;
      }
    }
    lose_held(s, cell, slot.cycle, node);
  }
}

// Empties the inputs of a node that went down; restarts its workers when it is up again.
template <class S>
[[gnu::noinline]] void turn_sites(S& s, i64 node, bool is_down, i64 now) {
  for (i64 row = 0; row < s.sites.size; ++row) {
    Site& site = s.sites[row];
    if (site.node != node) continue;
    if (is_down) {
      drop_waiting(s, site, now);
      forget_values(s, row);
      site.idle = site.workers;
      continue;
    }
    const i64 ready_ns = now + site.start_ns;
    site.ready_at_ns = 0;
    if (ready_ns > now) {
      site.ready_at_ns = ready_ns;
      s.post(ready_ns, make_key(kRestart, site.cell, 0, row));
    }
  }
  if (is_down) lose_joins(s, node);
}

// Gives the workers of a restarted node the jobs that wait, unless it is down again.
template <class S>
void restart(S& s, Site& site, i64 now) {
  if (site.ready_at_ns != now) return;
  site.ready_at_ns = 0;
  const i64 waiting = std::min(site.waiting, site.idle);
  site.idle -= waiting;
  for (i64 i = 0; i < waiting; ++i) free_worker(s, site);
}

template <class S>
void change_server(S& s, Server& server, const Change& change, bool turns, i64 now) {
  tick(s, server, now);
  if (turns && change.is_down) crash(s, server, now);
  server.is_down = change.is_down != 0;
  if (has_below(s, server)) {
    Server& below = s.servers[server.below];
    tick(s, below, now);
    if (turns && change.is_down) crash(s, below, now);
    below.is_down = server.is_down;
  }
  if (server.is_cpu) {
    renew_before_stress(s, server, now);
    const bool anew = change.stress != server.stress || (turns && change.is_down);
    if (anew && takes_turns(s, server)) restress(s, server, change.stress);
    server.stress = change.stress;
  }
  set_speed(s, server);
  mark(s, server);
}

// Announces the next change of a node.
template <class S>
void announce_change(S& s) {
  const i64 next = s.clock[0].next_change;
  if (next < s.changes.size) s.post(s.changes[next].at_ns, make_key(kChange, 0, 0, 0));
}

// Applies the next change of a node: foreign threads, down, up.
template <class S>
[[gnu::noinline]] void change_node(S& s, i64 now) {
  const Change& change = s.changes[s.clock[0].next_change++];
  const Node& node = s.nodes[change.node];
  bool turns = false;
  for (i64 row = node.server_0; row < node.server_0 + node.n_servers; ++row) {
    Server& server = s.servers[row];
    turns = (server.is_down != 0) != (change.is_down != 0);
    change_server(s, server, change, turns, now);
  }
  if (turns) turn_sites(s, change.node, change.is_down != 0, now);
  announce_change(s);
}

}  // namespace dwell
