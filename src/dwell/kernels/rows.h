// The rows of the kernel's tables, and what it is handed: every table and how many rows it has.
//
// Each field is declared here and nowhere else: the lists below make the structs, and layout.cpp
// tells Python what fields they have, of which it makes structs of its own and types of arrays.
//
// A *site* is a task on one feasible node of one cell; a *server* is what executes jobs: the CPU of
// a node, or one kind of its accelerators; a *hop* is a flow on a link. A cell may have a *shadow*:
// another row of `cells`, with sites and hops of its own on the same servers and links, whose
// cycles are released by those of its parent. A *pair* of candidates (active, other) is row
// `pair_0 + active * n_candidates + other` of `shadow_parts`. Times are nanoseconds.
#pragma once

#include <cstdint>

#include "sfc64.h"

namespace dwell {

using i8 = std::int8_t;
using i16 = std::int16_t;
using i32 = std::int32_t;
using i64 = std::int64_t;
using u64 = std::uint64_t;
using f64 = double;
using Times = const i64*;

// Number of strengths of a disturbance: those of a ramp's steps, and none
// (dwell.model.scenario.RAMP_STEPS); and a number for each.
constexpr i64 kLevels = 32;
using Levels = i64[kLevels];
using Shares = f64[kLevels];

struct Crossing;  // of meter.cpp

// The lists are tables: a row of fields a line.
// clang-format off

// Numbers of the whole simulation. Up to `n_slots` cycles of a cell, a power of two, may be in
// flight, each of up to `n_tasks` jobs and `n_flows` messages; one event adds `margin` events at
// most, and one more per held message. A call ends after `budget` events.
#define DWELL_CLOCK(field)                                                                       \
  field(i64, n_slots) field(i64, n_tasks) field(i64, n_flows) field(i64, n_layers)               \
  field(i64, n_resources) /* of a cell */                                                        \
  field(i64, has_shared) /* whether cells have servers in common */                              \
  field(i64, n_cycles) field(i64, n_windows) field(i64, n_looks)                                 \
  field(i64, n_priced) /* columns of the outputs */                                              \
  field(i64, margin) field(i64, budget)                                                          \
  field(i64, logs_all) /* whether logs are of all cycles, or of those in the ring */             \
  field(i64, n_events) field(i64, first_event) field(i64, used_events) field(i64, free_event)    \
  field(i64, n_held)                                                                             \
  field(i64, is_calendar) field(i64, day_bits) /* a day is 2^day_bits ns; see queue.h */         \
  field(i64, next_change)                                                                        \
  field(i64, pauses) /* whether a call ends when the cell is to be decided on */                 \
  field(i64, closed_cell)                                                                        \
  field(i64, step_key) field(i64, step_ns)                                                       \
  field(i64, end_ns) /* of the last close that any cell can have */                              \
  field(i64, plays_on) /* up to there, also where no window is left to close */

// A window closes no earlier than `due_ns` after the release of its last cycle, and `grace_ns` after
// that of the one beyond it. `wakes_ns` is when the guard is woken if no cycle from `waited` on has
// been heard to complete, and `patience_ns` is g periods. Decisions that come more often than
// windows look at `decide_cycles` cycles each, the next one at those before `look_cycle`, and the
// first `look_0` of the placement in force begins with the cycle `since`; 0 for one a window.
#define DWELL_CELL(field)                                                                        \
  field(Times, release_ns) field(i64, due_ns) field(i64, grace_ns)                               \
  field(i64, n_cycles) field(i64, window) field(i64, window_first) field(i64, close_cycle)       \
  field(i64, close_pending) field(i64, window_cycles) field(i64, migrating)                      \
  field(i64, decide_cycles) field(i64, since) field(i64, look_0) field(i64, look)                \
  field(i64, look_cycle) field(i64, look_pending)                                                \
  field(i64, deadline_ns) field(f64, longest_ms) /* with which latencies beyond it count */       \
  field(i64, wakes_ns) field(i64, patience_ns) field(i64, waited)                                \
  field(i64, period_ns) field(i64, released) /* cycles */                                        \
  field(i64, given_up_after) /* cycles released since, of a shadow under way */                  \
  field(i32, task_0) field(i32, n_tasks) field(i32, flow_0) field(i32, candidate_0)              \
  field(i32, n_candidates) field(i32, n_sinks) field(i32, pair_0)                                \
  field(i32, resource_0) field(i32, n_resources) /* in `cell_servers` */                         \
  field(i32, shadow) field(i32, parent)

#define DWELL_TASK(field)                                                                        \
  field(i64, offset_ns)                                                                          \
  field(i32, n_in) field(i32, n_out) field(i32, out_0) /* in `outputs` */

#define DWELL_FLOW(field) field(i32, source) field(i32, target)

// What a job uses of its server, `need`, is the cores that it holds, the threads that share them
// where the server is fair, or a place. Its work is done by `threads` threads. `own` is the row of
// its cell and server in `own_ns`.
#define DWELL_SITE(field)                                                                        \
  field(Times, exec_ns)                                                                          \
  field(i64, need) field(i64, threads)                                                           \
  field(i64, idle) field(i64, waiting) field(i64, head) field(i64, tail) field(i64, depth)       \
  field(i64, ready_at_ns)                                                                        \
  field(i32, cell) field(i32, task) field(i32, server) field(i32, node) field(i32, own)          \
  field(i32, rank)                                                                               \
  field(i64, workers) field(i64, start_ns)                                                       \
  field(i64, mean_ns) /* of `exec_ns`, as the file states it */

// `busy_ns` is in core-nanoseconds, of which 64 bits may not hold those of all cores. `quota` is a
// row of `quotas`, -1 for none. Shadow jobs run on a server of their own, `below` that of the own
// jobs, which is `above` it; -1 for none. To it `stress`, `is_down` and `is_stopped` are copied,
// `cores` and `spare` are what is left to it, and it adds `lent` busy cores and `background` to
// those above. `beside_ns` is what of `virtual_ns` went by beside foreign threads that interfere.
#define DWELL_SERVER(field)                                                                      \
  field(f64, virtual_ns) field(f64, beside_ns) field(f64, speed)                                 \
  field(i64, last_ns) field(i64, next_ns) field(i64, next_key)                                   \
  field(i64, used) field(i64, stress) field(i64, cores) field(i64, lent)                         \
  field(i32, above) field(i32, below)                                                            \
  field(i32, base) field(i32, n_run) field(i32, n_wait) field(i32, quota) field(i32, node)       \
  field(i8, scheduler) field(i8, is_down) field(i8, is_dirty) field(i8, is_cpu)                  \
  field(i8, is_stopped) /* by its quota */                                                       \
  field(f64, busy_ns) field(f64, behind_ns) field(f64, spare) field(f64, background)             \
  field(f64, beside) field(f64, used_ns) /* integral of `used` */

// `tick_ns` is the time between ticks, 0 for a quota that is noticed at once; at time 0 the last
// tick was `tick_ago_ns` and the last begin of a period `period_ago_ns` ago. `has_turn` says
// whether a thread has the turn, `turn_begun_ns` what it had received before, and `turn_ns` what
// since; a turn lasts `least_ns` at least. `drawn_ns` is what is drawn on a pool at a time.
// `wakes_ns` is when something of the background wakes next, for the `wakes`-th time, and
// `wake_gap_ns` the mean time between two. All that a quota counts is in time of the core.
#define DWELL_QUOTA(field)                                                                       \
  field(i64, looks_ns)                                                                           \
  field(i64, period_ns) field(i64, period) field(i64, quota_ns) field(i64, stressed_ns)          \
  field(i64, left_ns) field(i64, pool_ns) field(i64, slack_ns)                                   \
  field(i64, tick_ns) field(i64, tick_ago_ns) field(i64, period_ago_ns)                          \
  field(i64, has_turn) field(i64, turn_begun_ns) field(i64, turn_ns)                             \
  field(i64, least_ns) field(i64, drawn_ns)                                                      \
  field(i64, wakes_ns) field(i64, wakes) field(u64, wake_key) field(f64, wake_gap_ns)

// Servers of a node: its CPU first.
#define DWELL_NODE(field) field(i32, server_0) field(i32, n_servers)

// Rows of a realisation's `NodeChanges`, and of its `LinkSegments`, as they are.
#define DWELL_CHANGE(field)                                                                      \
  field(i64, at_ns) field(i64, node) field(i64, stress) field(i64, is_down)
#define DWELL_SEGMENT(field)                                                                     \
  field(i64, at_ns) field(i64, link) field(i64, is_down) field(i64, layers) /* a bit each */
#define DWELL_RATE(field) field(f64, rate_mbps) field(f64, loss)

#define DWELL_HOP(field)                                                                         \
  field(Times, delay_ns) field(u64, loss_key) field(i64, payload_bytes) field(i64, link)

// `retransmit_ns` is -1 where what is lost is lost.
#define DWELL_LINK(field)                                                                        \
  field(i64, free_ns) field(i64, last_arrival_ns) field(i64, retransmit_ns)                      \
  field(i64, in_order) field(i64, n_held) field(i64, segment) field(i64, segment_end)

// A message that waits for those before it, or is being repeated (order.h): the event of its
// arrival, and when that would be without the wait.
#define DWELL_HELD(field) field(i64, key) field(i64, link) field(i64, arrival_ns)

#define DWELL_EVENT(field) field(i64, at_ns) field(i64, key)

// A job that runs, by the virtual time at which it ends.
#define DWELL_RUNNING(field) field(f64, finish_ns) field(i64, key)

// A job that waits for cores, or a thread that waits for its turn.
#define DWELL_WAITING(field)                                                                     \
  field(i64, rank) field(i64, ready_ns) field(i64, key) field(f64, left_ns)

// A job in flight. `missing` counts the inputs that have not arrived. `beside_ns` is what it did
// beside foreign threads, by the `beside_ns` of its server; less that clock while it runs.
#define DWELL_JOB(field)                                                                         \
  field(i64, ready_ns) field(i64, started_ns) field(i64, compute_ns) field(i64, network_ns)      \
  field(i64, next) field(f64, beside_ns) field(i32, site)                    \
  field(i32, missing)

// A cycle in flight. `live` counts its jobs and messages that are under way.
#define DWELL_SLOT(field)                                                                        \
  field(i64, cycle) field(i32, candidate) field(i32, pair) field(i32, live)                      \
  field(i32, sinks_left) field(i32, is_lost)

// `used_ns` is the integral of `used` of the job's server while the job ran, and `above_ns` that of
// the server above it; both where cells share servers.
#define DWELL_LOG(field)                                                                         \
  field(i64, ready_ns) field(i64, start_ns) field(i64, end_ns) field(i64, work_ns)               \
  field(i64, used_ns) field(i64, above_ns)

// Cycles as they could be known when a window closed, or a decision was due: `uncut_ms` is L95
// without the cell's `longest_ms`.
#define DWELL_SEEN(field)                                                                        \
  field(i64, first_cycle) field(i64, cycles) field(i64, missed)                                  \
  field(f64, l95_ms) field(f64, uncut_ms)

// What a built-in policy with the estimator `profile` decides by (rules.h): its own numbers, the
// objective's, where the cell is, and what `ATP` has added up since its last decision. Of two
// numbers with the same name in `Objective` one is a weight and one a target.
#define DWELL_RULE(field)                                                                        \
  field(i64, policy) field(i64, is_priced)                                                       \
  field(i64, incumbent) field(i64, previous) field(i64, dwell) field(i64, stamped)               \
  field(i64, min_dwell) field(i64, escape) field(f64, min_improvement)                           \
  field(f64, threshold) field(f64, slack) field(f64, memory) field(f64, gain_tolerance)          \
  field(i64, local) field(i64, offload) field(i64, every_windows) field(i64, outside_is_cloud)   \
  field(f64, most_ms) field(f64, most_robot) field(f64, most_outside)                            \
  field(i64, n_shown) field(f64, shown_ms) field(f64, shown_robot) field(f64, shown_edge)        \
  field(f64, shown_cloud) field(f64, told_ms) field(f64, told_robot) field(f64, told_edge)       \
  field(f64, told_cloud)                                                                         \
  field(f64, weight_latency) field(f64, weight_violations) field(f64, weight_robot)              \
  field(f64, weight_edge) field(f64, weight_cloud) field(f64, weight_switching)                  \
  field(f64, target_ms) field(f64, target_robot) field(f64, target_edge)                         \
  field(f64, target_cloud) /* 0 where clouds are not weighed apart */                            \
  field(f64, cap_ms) field(f64, cap_utilisation)

// A candidate: what is expected of it, its cumulative sum, and whether its toggled task is on a
// robot.
#define DWELL_OPTION(field)                                                                      \
  field(f64, l95_ms) field(f64, uncut_ms) field(f64, violation_rate) field(f64, sum)             \
  field(i64, on_robot)

// The decision at the close of a window; `measured` is J of the window itself.
#define DWELL_DECIDED(field)                                                                     \
  field(f64, measured) field(f64, delta_j) field(i64, dwell)                                     \
  field(i32, incumbent) field(i32, placement) field(i32, reason)

// Intervals in order, none of which begins before the one ahead of it has ended (see
// on_off_intervals.h); `passed` counts the begins and ends that are over.
#define DWELL_ON_OFF(field)                                                                      \
  field(Times, begin_ns) field(Times, end_ns) field(Times, levels) field(i64, count)             \
  field(i64, passed)

// What one disturbance does to a node.
#define DWELL_EFFECT(field)                                                                      \
  field(OnOffIntervals, intervals) field(i64, node) field(i64, down) field(Levels, threads)

// What one disturbance does to a link; `arriving` is the share of attempts that it does not lose.
#define DWELL_FAULT(field)                                                                       \
  field(OnOffIntervals, intervals) field(i64, down) field(Levels, layers)                        \
  field(Shares, arriving) field(Shares, rate_mbps)

// A path of a random process and how far it is drawn (draw.cpp). `location` is the value of a
// constant, the lower end of a uniform one, else the normal's mean; `spread` the length of the
// interval, else the normal's deviation; no normal value is below `least`. Of a lognormal one
// `correlation` is that of a cycle's logarithm with the cycle's before, `gain` sqrt(1 -
// correlation^2), and `last` the last standard normal, NaN where the path has not begun.
#define DWELL_PATH(field)                                                                        \
  field(Sfc64, stream) field(i64, kind) field(f64, location) field(f64, spread)                  \
  field(f64, least) field(f64, correlation) field(f64, gain) field(f64, last)

// What cycles under one candidate go through (meter.cpp): the source of each flow, then in row 0 for
// the cycles themselves, in row 1 + i for their shadows through candidate i, the part of each task
// and of each flow, -1 for none of their own, and whether a flow's source is shared with the cycle.
#define DWELL_LAYOUT(field)                                                                      \
  field(i64, n_tasks) field(i64, n_flows) field(Times, sources) field(Times, parts)              \
  field(const i8*, shared)

// A row per cycle of a window: the candidate that it went through, when its jobs became ready, when
// they completed, when its messages arrived, the core time of its jobs, and when they started, -1
// for what had not come or is not known; then, if there are shadows, the same of its shadow, the
// candidate being -1 where it has none.
#define DWELL_WINDOW(field) field(i64*, rows) field(i64, n) field(i64, width)

// The jobs of a node (jobs.cpp): `cores` of each candidate and task, 0 for a task that is not there;
// cores of the node, and those that its background leaves; foreign threads next to jobs, and the
// share of the time in which there are bursts.
#define DWELL_NODE_JOBS(field)                                                                   \
  field(i64, n_tasks) field(i64, n_flows) field(const f64*, cores) field(i64, is_fair)           \
  field(f64, n_cores) field(f64, spare) field(f64, foreign) field(f64, bursts)

// The times found: up to `most` of each part, and the parts in the order in which they were found.
// Where demands are asked for, and not times, there is a `cost` of each part: of a job its time
// alone over its core time, of a message the nanoseconds that its link takes to send it; a `link`
// on which messages wait, -1 for none; and whether it `repeats` messages and keeps their order.
#define DWELL_FOUND(field)                                                                       \
  field(f64*, ms) field(i64*, count) field(i64*, order) field(i64, most) field(i64, n_parts)     \
  field(const f64*, cost) field(const i64*, link) field(const i64*, repeats)                     \
  field(Crossing*, crossings) field(i64, n_crossings)

// What a window has brought of a part: how many values, and the sums of their places.
#define DWELL_CHUNK(field)                                                                       \
  field(i64, window) field(i64, cycles) field(i64, size)                                         \
  field(f64, larger) field(f64, smaller) field(f64, places)

// What is held of a part (pools.cpp): its `n_known` values as declared, ascending, of which stretches
// of `block` cycles are alike by `likeness`; `size` values since `first`, with the sums of their
// places; the windows that they are from, and all cycles of those; for how many cycles they have not
// been as declared; how many were measured; and the windows of the last of them, and in which it
// last ceased to be as declared, or got another value since; whether Python asks for the next window;
// how often the held values have changed; whether Python doubts that they still hold;
// the cycles and sums of a run of windows that are larger, or smaller, 0 for none; and the values,
// ascending, that were held before it, 0 where these are the declared ones; how many declared values
// are below each of equal parts of their range.
#define DWELL_POOL(field)                                                                        \
  field(const f64*, known) field(i64, n_known) field(f64, patience_ms) field(f64, likeness)      \
  field(i64, block) field(f64*, held) field(i64, first) field(i64, size)                         \
  field(f64, larger) field(f64, smaller) field(f64, places)                                      \
  field(Chunk*, chunks) field(i64, first_chunk) field(i64, n_chunks)                             \
  field(i64, cycles) field(i64, lasting) field(i64, measured) field(i64, last)                   \
  field(i64, touched) field(i64, is_declared) field(i64, asks) field(i64, changes)                \
  field(i64, doubts) field(i64, run_cycles) field(i64, run_size)                                                    \
  field(f64, run_larger) field(f64, run_smaller) field(f64, run_places)                          \
  field(f64*, before) field(i64, n_before)                                                       \
  field(const i32*, guide) field(f64, guide_low) field(f64, guide_parts_per_ms)

#define DWELL_ROWS(row)                                                                          \
  row(Clock, DWELL_CLOCK) row(Cell, DWELL_CELL) row(Task, DWELL_TASK) row(Flow, DWELL_FLOW)      \
  row(Site, DWELL_SITE) row(Server, DWELL_SERVER) row(Quota, DWELL_QUOTA)                        \
  row(Node, DWELL_NODE) row(Change, DWELL_CHANGE) row(Hop, DWELL_HOP)                            \
  row(Link, DWELL_LINK) row(Held, DWELL_HELD)                                                    \
  row(Segment, DWELL_SEGMENT) row(Rate, DWELL_RATE)                                              \
  row(Event, DWELL_EVENT) row(Running, DWELL_RUNNING) row(Waiting, DWELL_WAITING)                \
  row(Job, DWELL_JOB) row(Slot, DWELL_SLOT) row(Log, DWELL_LOG) row(Seen, DWELL_SEEN)            \
  row(Rule, DWELL_RULE) row(Option, DWELL_OPTION) row(Decided, DWELL_DECIDED)                    \
  row(OnOffIntervals, DWELL_ON_OFF) row(NodeEffect, DWELL_EFFECT) row(LinkFault, DWELL_FAULT)    \
  row(DrawnPath, DWELL_PATH) row(Layout, DWELL_LAYOUT) row(Window, DWELL_WINDOW)                 \
  row(Found, DWELL_FOUND) row(NodeJobs, DWELL_NODE_JOBS) row(Chunk, DWELL_CHUNK)   \
  row(Pool, DWELL_POOL)

// clang-format on

#define DWELL_FIELD(type, name) type name;
#define DWELL_STRUCT(name, fields) \
  struct name {                    \
    fields(DWELL_FIELD)            \
  };
DWELL_ROWS(DWELL_STRUCT)
#undef DWELL_STRUCT
#undef DWELL_FIELD

// clang-format off

// Fixed, then state, then outputs: per cycle, per window, and logs where they are kept. Shapes are
// in rows.py.
#define DWELL_TABLES(table)                                                                      \
  table(Clock, clock) table(Cell, cells) table(Task, tasks) table(Flow, flows)                   \
  table(i32, outputs) table(i32, cell_servers) table(f64, capacity) table(Node, nodes)           \
  table(i32, site_of) table(i32, route) table(i64, back_ns) table(i8, shadow_parts)              \
  table(Hop, hops) table(Times, layers) table(Segment, segments) table(Rate, rates)              \
  table(Change, changes) table(f64, work) table(f64, switching)               \
  table(i8, tiers) table(i16, stamps)                                                            \
  table(Site, sites) table(Server, servers) table(Quota, quotas) table(Link, links)              \
  table(Event, events) table(i32, following) table(i32, days) table(Held, held)                  \
  table(Running, running) table(Waiting, waiting)                                                \
  table(i32, dirty) table(i64, ready) table(Job, jobs) table(Slot, slots) table(i64, attempts)   \
  table(f64, own_ns) table(i64, soonest_ns) table(i64, ages)                                     \
  table(Rule, rule) table(Option, options) table(f64, shown)                                     \
  table(i64, latency_ns) table(i64, compute_ns) table(i64, network_ns) table(i8, outcome)        \
  table(f64, opened) table(f64, closed) table(Seen, seen) table(f64, shares)                     \
  table(f64, look_opened) table(f64, look_closed) table(Seen, looked) table(f64, look_shares)    \
  table(Decided, decided) table(f64, priced)                                                     \
  table(i64, shadow_bytes) table(Log, log) table(i8, log_outcome) table(i64, log_arrived)

// clang-format on

// A table and how many rows, or numbers, it has.
template <class Row>
struct Table {
  Row* rows;
  i64 size;

  Row& operator[](i64 i) const { return rows[i]; }
};

#define DWELL_TABLE(type, name) Table<type> name;
struct Tables {
  DWELL_TABLES(DWELL_TABLE)
};
#undef DWELL_TABLE

}  // namespace dwell
