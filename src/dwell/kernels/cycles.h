// The events of a cycle: release, inputs, workers, completion, loss.
#pragma once

#include "chains.h"
#include "links.h"
#include "remainders.h"

namespace dwell {

// Core time of a completed job: its work, and the extra core time caused by interfering foreign
// threads.
template <class S>
i64 core_time(const S& s, const Job& job, i64 cycle) {
  const Site& site = s.site(job);
  const i64 exec_ns = site.exec_ns[cycle];
  if (exec_ns > kLastNs / site.threads) return kLastNs;
  const f64 more = job.beside_ns * (1.0 / s.server(site).beside - 1.0);
  return later(site.threads * exec_ns, whole_ns(std::rint(static_cast<f64>(site.need) * more)));
}

template <class S>
void log_job(S& s, i64 cell, i64 cycle, i64 task, const Job& job, Outcome outcome, i64 end_ns) {
  if (S::kPlain || s.log.size == 0) return;
  const i64 row = s.log_entry(cell, cycle, task);
  const i64 work_ns = outcome == kDone ? core_time(s, job, cycle) : -1;
  Log& entry = s.log[row];
  if (outcome == kDone) {
    log_beside(s, s.server(s.site(job)), entry, 1, end_ns);
  } else {
    entry.used_ns = entry.above_ns = 0;
  }
  entry = Log{job.ready_ns, job.started_ns, end_ns, work_ns, entry.used_ns, entry.above_ns};
  s.log_outcome[row] = outcome;
}

// Clears the logs of the earlier cycle whose place this cycle takes.
template <class S>
void clear_log(S& s, i64 cell, i64 cycle) {
  if (S::kPlain || s.log.size == 0) return;
  const i64 row = s.log_row(cell, cycle);
  std::fill_n(&s.log[row * s.n_tasks], s.n_tasks, Log{-1, -1, -1, -1, 0, 0});
  std::fill_n(&s.log_outcome[row * s.n_tasks], s.n_tasks, i8{kInFlight});
  std::fill_n(&s.log_arrived[row * s.n_flows], s.n_flows, i64{-1});
  if (S::kRates) std::fill_n(&s.log_taken[row * s.n_flows], s.n_flows, i64{-1});
}

// Loses a ready job, and therefore its cycle if a sink needs the job.
template <class S>
void drop_job(S& s, i64 cell, i64 cycle, i64 task, Outcome outcome, i64 now) {
  log_job(s, cell, cycle, task, s.job(cell, cycle, task), outcome, now);
  s.slot(cell, cycle).live -= 1;
  lose(s, cell, cycle, task, outcome);
}

template <class S>
void append_input(S& s, Site& site, i64 cycle, Job& job) {
  job.next = -1;
  if (site.waiting == 0) {
    site.head = cycle;
  } else {
    s.job(site.cell, site.tail, task_at(s, site, site.tail)).next = cycle;
  }
  site.tail = cycle;
  site.waiting += 1;
}

// Removes the oldest waiting job of a site and returns its cycle.
template <class S>
i64 pop_input(S& s, Site& site) {
  const i64 cycle = site.head;
  site.head = s.job(site.cell, cycle, task_at(s, site, cycle)).next;
  site.waiting -= 1;
  return cycle;
}

// Removes the job of a cycle from the jobs that wait at a site; returns whether it was there.
template <class S>
[[gnu::noinline]] bool remove_input(S& s, Site& site, i64 cycle) {
  i64 before = -1, waits = site.head;
  for (i64 i = 0; i < site.waiting; ++i) {
    const i64 next = s.job(site.cell, waits, task_at(s, site, waits)).next;
    if (waits == cycle) {
      if (before < 0) {
        site.head = next;
      } else {
        s.job(site.cell, before, task_at(s, site, before)).next = next;
      }
      if (site.tail == waits) site.tail = before;
      site.waiting -= 1;
      return true;
    }
    before = waits;
    waits = next;
  }
  return false;
}

// Puts a job whose inputs are complete on the ready list; `settle` handles it after the event.
template <class S>
void note_ready(S& s, i64 key) {
  s.ready[s.n_ready++] = key;
}

// Queues a ready job at its site, or loses it; returns true if an idle worker takes it at once.
template <class S>
bool become_ready(S& s, i64 cell, i64 cycle, i64 task, i64 now) {
  Job& job = s.job(cell, cycle, task);
  job.ready_ns = now;
  note_soonest(s, cell, cycle, task, now);
  log_job(s, cell, cycle, task, job, kInFlight, -1);
  Site& site = s.site(job);
  if (s.server(site).is_down) {
    drop_job(s, cell, cycle, task, kNodeDown, now);
    return false;
  }
  if (site.idle > 0 && site.ready_at_ns == 0) {
    site.idle -= 1;
    return true;
  }
  if (site.depth > 0 && site.waiting >= site.depth) {
    if (cycle < site.head) {
      drop_job(s, cell, cycle, task, kReplaced, now);
      return false;
    }
    const i64 oldest = pop_input(s, site);
    drop_job(s, cell, oldest, task_at(s, site, oldest), kReplaced, now);
  }
  append_input(s, site, cycle, job);
  return false;
}

// Gives a free worker the next waiting job; without one it becomes idle.
template <class S>
void free_worker(S& s, Site& site) {
  if (site.waiting == 0) {
    site.idle += 1;
    return;
  }
  const i64 cycle = pop_input(s, site);
  note_ready(s, job_key(site.cell, cycle, task_at(s, site, cycle)) | kTaken);
}

// Loses all jobs that wait at a site, because its node went down.
template <class S>
void drop_waiting(S& s, Site& site, i64 now) {
  while (site.waiting > 0) {
    const i64 cycle = pop_input(s, site);
    drop_job(s, site.cell, cycle, task_at(s, site, cycle), kNodeDown, now);
  }
}

// Whether the shadow of a cycle stops before a task.
template <class S>
bool is_discarded(const S& s, i64 cell, i64 cycle, i64 task) {
  if (S::kPlain || s.cell(cell).parent < 0) return false;
  return s.shadow_parts[s.slot(cell, cycle).pair * s.n_tasks + task] == kDiscarded;
}

// Shadow that shares a task with a cycle, -1 for none.
template <class S>
i64 shared_by(const S& s, i64 cell, i64 cycle, i64 task) {
  if (S::kPlain) return -1;
  const i64 shadow = s.cell(cell).shadow;
  if (shadow < 0 || s.stamp(shadow, cycle) < 0) return -1;
  if (is_given_up(s, shadow, cycle)) return -1;
  const i64 pair = s.slot(shadow, cycle).pair;
  return s.shadow_parts[pair * s.n_tasks + task] == kShared ? shadow : -1;
}

// Counts a sink of a shadow that has all its inputs, or a sampled output of a shadow job; the last
// one completes the shadow.
template <class S>
void finish_shadow(S& s, i64 shadow, i64 cycle, i64 now) {
  if (--s.slot(shadow, cycle).sinks_left > 0) return;
  s.latency_ns[s.output(shadow, cycle)] = now - s.cell(shadow).release_ns[cycle];
}

// Counts an arrived input; the last input makes the job ready and determines its critical path.
template <class S>
void hand_over(S& s, i64 cell, i64 cycle, i64 flow, i64 now) {
  const Flow& ends = s.flow(cell, flow);
  const i64 target = end_of(s, cell, cycle, ends.target);
  Job& job = s.job(cell, cycle, target);
  if (!S::kPlain && s.log_arrived.size > 0) {
    s.log_arrived[s.log_row(cell, cycle) * s.n_flows + flow] = now;
  }
  if (S::kRates && ends.is_sampled) {
    s.slot(cell, cycle).live -= 1;
    if (s.cell(cell).parent >= 0) {
      finish_shadow(s, cell, cycle, now);
    } else {
      bring_value(s, cell, cycle, flow, job.site, now);
    }
    return;
  }
  if (is_late(s, cell, cycle, flow, target)) {
    s.slot(cell, cycle).live -= 1;
    return;
  }
  job.missing -= 1;
  if (job.missing == 0 && !is_discarded(s, cell, cycle, target)) {
    const Job& sender = s.job(cell, cycle, end_of(s, cell, cycle, ends.source));
    job.compute_ns = sender.compute_ns;
    job.network_ns = now - sender.network_ns;
    note_ready(s, job_key(cell, cycle, target));
  } else {
    s.slot(cell, cycle).live -= 1;
    if (job.missing == 0) finish_shadow(s, cell, cycle, now);
  }
}

// Handles a message that reaches its node, or is lost on its link.
template <class S>
void arrive(S& s, i64 cell, i64 cycle, i64 flow, i64 now) {
  Outcome loss = kDropped;
  if (!(flow & kLostOnLink)) {
    const Job& job = s.job(cell, cycle, end_of(s, cell, cycle, s.flow(cell, flow).target));
    if (!s.server(s.site(job)).is_down) {
      hand_over(s, cell, cycle, flow, now);
      return;
    }
    loss = kNodeDown;
  }
  s.slot(cell, cycle).live -= 1;
  lose_input(s, cell, cycle, flow & ~kLostOnLink, loss);
}

// Counts a completed sink; the last sink completes the cycle.
template <class S>
void finish(S& s, i64 cell, i64 cycle, i64 task, const Job& job, i64 now) {
  const i64 shadow = shared_by(s, cell, cycle, task);
  if (shadow >= 0) finish_shadow(s, shadow, cycle, now);
  Slot& slot = s.slot(cell, cycle);
  slot.live -= 1;
  slot.sinks_left -= 1;
  if (slot.sinks_left > 0) return;
  const i64 row = s.output(cell, cycle);
  s.outcome[row] = kDone;
  s.latency_ns[row] = now - s.cell(cell).release_ns[cycle];
  s.compute_ns[row] = job.compute_ns;
  s.network_ns[row] = job.network_ns;
  S::fetch_next(s.latency_ns[row]);
  S::fetch_next(s.compute_ns[row]);
  S::fetch_next(s.network_ns[row]);
  announce_done(s, cell, cycle, now);
}

// Sends the outputs of a common task to second copies of tasks, or holds them until `after_ns`.
template <class S>
[[gnu::noinline]] void send_to_second(S& s, i64 cell, i64 cycle, i64 task, i64 now) {
  const Cell& of = s.cell(cell);
  const Task& from = s.task(cell, task + of.copies);
  const i64 after_ns = s.after_ns[s.slot(cell, cycle).candidate];
  const i64 due_ns = later(of.release_ns[cycle], after_ns);
  for (i32 i = from.out_0; i < from.out_0 + from.n_out; ++i) {
    const i64 flow = s.outputs[i];
    if (s.job(cell, cycle, s.flow(cell, flow).target).site < 0) continue;
    s.slot(cell, cycle).live += 1;
    if (now < due_ns) {
      attempts_of(s, cell, cycle, flow) = kIsHeld;
      s.post(due_ns, make_key(kRetry, cell, cycle, flow));
    } else if (const i64 hop = s.hop(cell, cycle, flow); hop < 0) {
      hand_over(s, cell, cycle, flow, now);
    } else {
      send(s, cell, cycle, flow, hop, 0, now);
    }
  }
}

// Hands a job's outputs over to tasks on its node, and sends the others.
template <class S>
void send_outputs(S& s, i64 cell, i64 cycle, i64 task, i64 now) {
  const Task& from = s.task(cell, task);
  if (from.n_out > 1) s.slot(cell, cycle).live += from.n_out - 1;
  // A shadow receives the outputs of shared tasks too, after the cycle's own outputs.
  const i64 shadow = shared_by(s, cell, cycle, task);
  const bool sends_twice = has_replicas(s, cell, cycle) && is_common(s, cell, cycle, task);
  i64 to = cell;
  while (true) {
    for (i32 i = from.out_0; i < from.out_0 + from.n_out; ++i) {
      const i64 flow = s.outputs[i];
      if (!s.is_due(s.flow(cell, flow), cycle)) {
        if (to == cell) s.slot(cell, cycle).live -= 1;
        continue;
      }
      if (to != cell) {
        if (S::kRates && s.flow(cell, flow).is_sampled) continue;
        if (shared_by(s, cell, cycle, s.flow(cell, flow).target) >= 0) continue;
        s.slot(shadow, cycle).live += 1;
      }
      const i64 hop = s.hop(to, cycle, flow);
      if (hop < 0) {
        hand_over(s, to, cycle, flow, now);
      } else {
        if (!S::kPlain && s.cell(to).parent >= 0) {
          // The sum is limited to 64 bits, like times.
          i64& bytes = s.shadow_bytes[s.cell(to).parent * s.clock[0].n_cycles + cycle];
          bytes = later(bytes, s.hops[hop].payload_bytes);
        }
        send(s, to, cycle, flow, hop, 0, now);
      }
    }
    if (sends_twice && to == cell) send_to_second(s, cell, cycle, task, now);
    if (shadow < 0 || to != cell) return;
    to = shadow;
  }
}

// Completes a job, unless its announcement is invalid.
template <class S>
void complete(S& s, i64 key, i64 now) {
  const i64 cell = cell_of(key), cycle = cycle_of(key), task = item_of(key);
  Job& job = s.job(cell, cycle, task);
  Site& site = s.site(job);
  Server& server = s.server(site);
  if (server.next_key != key || server.next_ns != now) return;
  leave(s, server, site, key, now);
  s.own_ns[site.own] += static_cast<f64>(site.threads) * static_cast<f64>(site.exec_ns[cycle]);
  job.compute_ns += now - job.started_ns;
  log_job(s, cell, cycle, task, job, kDone, now);
  if (S::kRates) actuate(s, cell, cycle, task, now);
  free_worker(s, site);
  if (s.task(cell, task).n_out == 0) {
    finish(s, cell, cycle, task, job, now);
  } else if (has_replicas(s, cell, cycle) && job.missing == kHeard) {
    s.slot(cell, cycle).live -= 1;
  } else {
    job.network_ns = now - job.network_ns;
    send_outputs(s, cell, cycle, task, now);
  }
}

// Sends a message again after a lost attempt, or at the end of its hold.
template <class S>
void retry(S& s, i64 cell, i64 cycle, i64 flow, i64 now) {
  i64& attempts = attempts_of(s, cell, cycle, flow);
  const i64 hop = s.hop(cell, cycle, flow);
  // The node of a held message went down.
  if (S::kRates && s.slot(cell, cycle).cycle != cycle) return;
  if (has_replicas(s, cell, cycle)) {
    if (attempts == kUnsent) return;
    if (is_stopped(s, cell, cycle, flow)) {
      s.slot(cell, cycle).live -= 1;
      end_repeats(s, make_key(kArrival, cell, cycle, flow), now);
      return;
    }
    if (attempts == kIsHeld) attempts = kUnsent;
    if (hop < 0) {
      hand_over(s, cell, cycle, flow, now);
      return;
    }
  }
  send(s, cell, cycle, flow, hop, attempts + 1, now);
}

// Starts a source, unless its node has heard that the cycle is done.
template <class S>
void start_source(S& s, i64 cell, i64 cycle, i64 task) {
  if (has_replicas(s, cell, cycle) && s.job(cell, cycle, task).missing == kHeard) {
    s.slot(cell, cycle).live -= 1;
  } else {
    note_ready(s, job_key(cell, cycle, task));
  }
}

// Lets the node of a task hear that a cycle is done: its jobs no longer wait in inputs.
template <class S>
[[gnu::noinline]] void hear(S& s, i64 cell, i64 cycle, i64 task) {
  Slot& slot = s.slot(cell, cycle);
  if (slot.cycle != cycle || slot.live == 0) return;
  const i64 node = s.site(s.job(cell, cycle, task)).node;
  for (i64 other = 0; other < s.cell(cell).n_tasks; ++other) {
    Job& job = s.job(cell, cycle, other);
    if (job.site < 0 || s.site(job).node != node) continue;
    job.missing = kHeard;
    if (remove_input(s, s.site(job), cycle)) slot.live -= 1;
  }
}

// Removes a running or waiting job of a shadow; its worker takes the next waiting job.
template <class S>
void withdraw(S& s, i64 key, Job& job, i64 now) {
  Site& site = s.site(job);
  Server& server = s.server(site);
  if (take_off(s, server, site, key, now)) {
    log_job(s, site.cell, cycle_of(key), site.task, job, kInFlight, -1);
    free_worker(s, site);
    return;
  }
  remove_input(s, site, cycle_of(key));
}

// Gives up a shadow that is still unfinished too many cycles later, when cycle `released` begins.
template <class S>
void give_up_before(S& s, i64 cell, i64 released, i64 now) {
  const Cell& of = s.cell(cell);
  const i64 shadow = of.shadow, cycle = released - of.given_up_after;
  if (shadow < 0 || cycle < 0 || s.stamp(shadow, cycle) < 0) return;
  Slot& slot = s.slot(shadow, cycle);
  if (slot.cycle != cycle || slot.live == 0) return;
  slot.live = 0;
  for (i64 task = 0; task < of.n_tasks; ++task) {
    Job& job = s.job(shadow, cycle, task);
    if (job.ready_ns < 0 || s.site(job).cell != shadow) continue;
    withdraw(s, job_key(shadow, cycle, task), job, now);
  }
}

// Marks every accelerator on which a shadow job waits: the job may be able to start.
template <class S>
void mark_accelerators(S& s) {
  for (i64 row = 0; row < s.servers.size; ++row) {
    Server& server = s.servers[row];
    if (is_below(s, server) && !server.is_cpu && server.n_wait > 0) mark(s, server);
  }
}

// Begins a cycle, or its shadow: the sources become ready.
//
// A shadow starts only the sources that it does not share, each by an event, like sources with an
// offset. It is complete when the sinks and the sampled outputs of its own jobs are.
template <class S>
void begin_cycle(S& s, i64 cell, i64 cycle, i64 active, bool is_shadow, i64 now) {
  const Cell& of = s.cell(cell);
  const i64 stamp = s.stamp(cell, cycle);
  const i64 candidate = of.candidate_0 + stamp;
  const i64 pair = of.pair_0 + active * of.n_candidates + stamp;
  i32 sources = 0, sinks = S::kRates ? 0 : of.n_sinks;
  for (i64 task = 0; task < of.n_tasks; ++task) {
    const Task& fixed = s.task(cell, task);
    Job& job = s.job(cell, cycle, task);
    job.missing = fixed.n_in;
    if (!S::kPlain) {
      job.ready_ns = -1;
      job.beside_ns = 0.0;
    }
    job.started_ns = -1;
    job.site = s.site_of[candidate * s.n_tasks + task];
    job.compute_ns = 0;
    job.network_ns = 0;
    const bool is_copy = is_second(s, cell, task);
    if (is_copy && job.site < 0) continue;
    if (S::kRates) {
      if (!s.is_due(fixed, cycle)) continue;
      sinks += fixed.n_out == 0;
      const bool runs = is_shadow && s.shadow_parts[pair * s.n_tasks + task] == kShadowed;
      if (runs) sinks += sampled_outputs(s, cell, fixed);
    }
    if (fixed.n_in > 0) continue;
    if (is_shadow) {
      const i8 part = s.shadow_parts[pair * s.n_tasks + task];
      if (part == kDiscarded) --sinks;  // it has no inputs to wait for
      if (part != kShadowed) continue;
    }
    ++sources;
    if (is_copy) {
      const i64 after_ns = std::max(fixed.offset_ns, s.after_ns[candidate]);
      s.post(later(now, after_ns), make_key(kStart, cell, cycle, task));
    } else if (!is_shadow && fixed.offset_ns == 0) {
      note_ready(s, job_key(cell, cycle, task));
    } else {
      s.post(now + fixed.offset_ns, make_key(kStart, cell, cycle, task));
    }
  }
  s.slot(cell, cycle) =
      Slot{cycle, static_cast<i32>(candidate), static_cast<i32>(pair), sources, sinks, kNothing};
  if (has_replicas(s, cell, cycle)) {
    std::fill_n(&attempts_of(s, cell, cycle, 0), s.n_flows, kUnsent);
  }
  if (sinks > 0) return;
  if (is_shadow) {
    s.latency_ns[s.output(cell, cycle)] = 0;
  } else if (S::kRates) {
    s.outcome[s.output(cell, cycle)] = kIdle;
  }
}

// Releases a cycle, and its shadow if it has one; announces the next release.
template <class S>
void release(S& s, i64 cell, i64 cycle, i64 now) {
  const i64 active = s.stamp(cell, cycle);
  s.cell(cell).released = cycle + 1;
  if (s.paid.size > 0) s.paid[s.output(cell, cycle)] = s.cell(cell).paid;
  if (!S::kPlain) give_up_before(s, cell, cycle, now);
  if (S::kRates) move_values(s, cell, cycle, now);
  clear_log(s, cell, cycle);
  begin_cycle(s, cell, cycle, active, false, now);
  if (!S::kPlain) {
    const i64 shadow = s.cell(cell).shadow;
    if (shadow >= 0) {
      mark_accelerators(s);
      clear_log(s, shadow, cycle);
      s.slot(shadow, cycle).cycle = cycle;  // its place in the logs, also without a shadow
      if (s.stamp(shadow, cycle) >= 0) begin_cycle(s, shadow, cycle, active, true, now);
    }
  }
  const i64 following = cycle + 1;
  if (following < s.cell(cell).n_cycles) {
    const i64* release_ns = &s.cell(cell).release_ns[following];
    s.post(*release_ns, make_key(kRelease, cell, following, 0));
    S::fetch_next(*release_ns);
  }
}

// Handles the jobs that the event has made ready.
template <class S>
void settle(S& s, i64 now) {
  for (i64 i = 0; i < s.n_ready; ++i) {
    const i64 key = s.ready[i];
    const i64 job = key & ~kTaken;
    if (key & kTaken || become_ready(s, cell_of(job), cycle_of(job), item_of(job), now)) {
      if (S::kRates) {
        take_values(s, job);
        descend(s, job);
      }
      admit(s, job, now);
    }
  }
  s.n_ready = 0;
}

// Assigns cores, and announces completions, on every server that the event changed.
template <class S>
void flush(S& s, i64 now) {
  for (i64 i = 0; i < s.n_dirty; ++i) {
    Server& server = s.servers[s.dirty[i]];
    const bool is_itself = !has_below(s, server) || is_concerned(s, server);
    const bool leaves = is_shared(s, server) || (server.is_dirty & kBelowIsDirty) != 0;
    server.is_dirty = 0;
    if (is_itself && server.scheduler != kFair) dispatch(s, server, now);
    if (leaves) leave_rest(s, server, now);
    if (is_itself) schedule(s, server, now);
  }
  s.n_dirty = 0;
}

}  // namespace dwell
