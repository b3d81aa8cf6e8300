// The rows of the kernel's tables, and its argument: every table with its number of rows.
//
// This file alone declares the fields. The lists below define the structs; layout.cpp describes
// their fields to Python, which builds its own structs and array types from the description.
//
// A *site* is a task on one feasible node of one cell. A *server* executes jobs: the CPU of a node,
// or one kind of its accelerators. A *hop* is a flow on a link. A cell may have a *shadow*: another
// row of `cells`, with its own sites and hops on the same servers and links. A release of a cycle
// also releases the cycle's shadow. A *pair* of candidates (active, other) is row
// `pair_0 + active * n_candidates + other` of `shadow_parts`. Times are nanoseconds.
#pragma once

#include <cstdint>

#include "sfc64.h"

namespace dwell {

using i8 = std::int8_t;
using i16 = std::int16_t;
using i32 = std::int32_t;
using i64 = std::int64_t;
using u32 = std::uint32_t;
using u64 = std::uint64_t;
using f64 = double;
using Times = const i64*;

// Number of strengths of a disturbance: one per step of a ramp
// (dwell.model.scenario.RAMP_STEPS), and off. `Levels` and `Shares` have one number per strength.
constexpr i64 kLevels = 32;
using Levels = i64[kLevels];
using Shares = f64[kLevels];

struct Crossing;  // of meter.cpp

// The lists are tables: one row of fields per line.
// clang-format off

// Numbers of the whole simulation. Up to `n_slots` cycles of a cell, a power of two, may be in
// flight, each of up to `n_tasks` jobs and `n_flows` messages; one event adds `margin` events at
// most, and one more per held message. A call ends after `budget` events.
#define DWELL_CLOCK(field)                                                                       \
  field(i64, n_slots) field(i64, n_tasks) field(i64, n_flows) field(i64, n_layers)               \
  field(i64, n_resources) /* of a cell */                                                        \
  field(i64, has_shared) /* whether cells have servers in common */                              \
  field(i64, has_rates) /* whether tasks skip cycles, flows are sampled, or chains or replicas exist */ \
  field(i64, n_cycles) field(i64, n_windows) field(i64, n_looks)                                 \
  field(i64, n_priced) /* columns of the outputs */                                              \
  field(i64, n_chains) /* of a cell */                                                           \
  field(i64, margin) field(i64, budget)                                                          \
  field(i64, logs_all) /* whether logs keep all cycles, or only the ring's */                    \
  field(i64, n_events) field(i64, first_event) field(i64, used_events) field(i64, free_event)    \
  field(i64, n_held) field(i64, n_repeats)                                                       \
  field(i64, is_calendar) field(i64, day_bits) /* a day is 2^day_bits ns; see queue.h */         \
  field(i64, next_change)                                                                        \
  field(i64, pauses) /* whether a call ends when a decision is due */                            \
  field(i64, closed_cell)                                                                        \
  field(i64, step_key) field(i64, step_ns)                                                       \
  field(i64, end_ns) /* latest end of a window of any cell */                                    \
  field(i64, plays_on) /* up to `end_ns`, even after the last window */

// A window ends `due_ns` after the release of its last cycle, or `grace_ns` after the release of
// the next cycle, whichever is later. `wakes_ns` is the instant at which the guard is woken unless
// it learns before that a cycle from `waited` on has completed, or until `chain_due_ns`, at which
// the patience for a chain may end. `patience_ns` is the guard's for cycles.
// `decide_cycles` is the number of cycles between decisions that are more frequent than windows; 0
// for one decision per window. The next decision looks at cycles before `look_cycle`. `since` is
// the first cycle under the placement in force, and `look_0` the first decision after it. If
// candidates have replicas, the second copies of the `copies` tasks and of the `flow_copies` flows
// follow the first copies (replicas.h); else both are 0.
// `latency_chain` is the chain whose data age counts as latency, -1 for none.
#define DWELL_CELL(field)                                                                        \
  field(Times, release_ns) field(i64, due_ns) field(i64, grace_ns)                               \
  field(i64, n_cycles) field(i64, window) field(i64, window_first) field(i64, close_cycle)       \
  field(i64, close_pending) field(i64, window_cycles) field(i64, migrating)                      \
  field(i64, decide_cycles) field(i64, since) field(i64, look_0) field(i64, look)                \
  field(i64, look_cycle) field(i64, look_pending)                                                \
  field(i64, deadline_ns) field(f64, longest_ms) /* larger latencies count as this */            \
  field(i64, wakes_ns) field(i64, patience_ns) field(i64, waited) field(i64, chain_due_ns)       \
  field(i64, period_ns) field(i64, released) /* cycles */                                        \
  field(i64, given_up_after) /* cycles after which a shadow is given up */                       \
  field(i32, task_0) field(i32, n_tasks) field(i32, flow_0) field(i32, candidate_0)              \
  field(i32, n_candidates) field(i32, n_sinks) field(i32, pair_0)                                \
  field(i32, copies) field(i32, flow_copies)                                                     \
  field(i32, sampled_0) field(i32, n_sampled) /* in `sampled` */                                 \
  field(i32, forward_0) field(i32, n_forwards) /* in `forwards` */                               \
  field(i32, resource_0) field(i32, n_resources) /* in `cell_servers` */                         \
  field(i32, n_flows) field(i32, chain_0) field(i32, n_chains) /* in `chains` */                 \
  field(i32, latency_chain) field(i32, weighs_age) /* whether `Seen` needs ages */               \
  field(f64, paid) /* price of all transmissions of the cell and its shadow so far */            \
  field(i32, shadow) field(i32, parent)

// Cycles of a chain's first task from which a job descends.
#define DWELL_DESCENT(field) field(i32, oldest) field(i32, newest)

// A chain of tasks; `last` is the origin of its last actuation. An older age than `max_age_ns` is a
// miss.
#define DWELL_CHAIN(field)                                                                       \
  field(i64, source) field(i64, target) field(i64, last) field(i64, max_age_ns)

// A task runs in every `every`-th cycle from 0 on. Its inputs are the `n_inputs` flows of the cell
// from `in_0` on; `n_in` counts the waited ones. The rates of the sinks to which waited flows lead
// from it, its own if it is a sink, are in `sink_rates`.
#define DWELL_TASK(field)                                                                        \
  field(i64, offset_ns) field(i64, every)                                                        \
  field(i32, n_in) field(i32, in_0) field(i32, n_inputs)                                         \
  field(i32, n_out) field(i32, out_0) /* in `outputs` */                                         \
  field(i32, rate_0) field(i32, n_rates)

// A flow carries a message in every `every`-th cycle.
#define DWELL_FLOW(field)                                                                        \
  field(i64, every) field(i32, source) field(i32, target) field(i32, is_sampled)

// A sampled flow over a link from a site of its target to another site: the messages that a node
// forwards after a move. Rows have the order of the flows, then of the links, of the file.
#define DWELL_FORWARD(field)                                                                     \
  field(i32, flow) field(i32, from_site) field(i32, to_site) field(i32, hop)

// The lost attempts of a forward that will be sent again; `key` is the event of its arrival.
#define DWELL_REPEAT(field) field(i64, key) field(i64, attempt)

// A job occupies `need` of its server: cores, or threads that share the cores of a fair server, or
// places of an accelerator. `threads` threads do its work. `own` is the row of its cell and server
// in `own_ns`.
#define DWELL_SITE(field)                                                                        \
  field(Times, exec_ns)                                                                          \
  field(i64, need) field(i64, threads)                                                           \
  field(i64, idle) field(i64, waiting) field(i64, head) field(i64, tail) field(i64, depth)       \
  field(i64, ready_at_ns)                                                                        \
  field(i32, cell) field(i32, task) field(i32, server) field(i32, node) field(i32, own)          \
  field(i32, rank)                                                                               \
  field(i64, workers) field(i64, start_ns)                                                       \
  field(i64, mean_ns) /* of `exec_ns`, as the file states it */

// `busy_ns` is in core-nanoseconds, a double because the sum over all cores may exceed 64 bits.
// `quota` is a row of `quotas`, -1 for none. Shadow jobs have their own server: the row `below` of
// the own jobs' server; `above` points back; -1 for none. The server below copies `stress`,
// `is_down` and `is_stopped`; its `cores` and `spare` are the rest that own jobs leave; it adds
// `lent` busy cores and `background` to the server above. `beside_ns` is the part of `virtual_ns`
// during which foreign threads interfered.
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

// `tick_ns` is the time between ticks, 0 for a quota that takes effect at once. At time 0 the last
// tick was `tick_ago_ns` ago, and the period had begun `period_ago_ns` ago. `has_turn` is 1 if a
// thread has the turn; `turn_begun_ns` is the core time that it had received before its turn, and
// `turn_ns` the core time since. A turn lasts `least_ns` at least. `drawn_ns` is the core time
// drawn from a pool at once. `wakes_ns` is the next instant at which a background thread wakes,
// `wakes` counts the wakes, and `wake_gap_ns` is the mean time between them. Quotas count core
// time.
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

// Rows of a realisation's `NodeChanges` and `LinkSegments`, unchanged.
#define DWELL_CHANGE(field)                                                                      \
  field(i64, at_ns) field(i64, node) field(i64, stress) field(i64, is_down)
#define DWELL_SEGMENT(field)                                                                     \
  field(i64, at_ns) field(i64, link) field(i64, is_down) field(i64, layers) /* a bit each */
#define DWELL_RATE(field) field(f64, rate_mbps) field(f64, loss)

#define DWELL_HOP(field)                                                                         \
  field(Times, delay_ns) field(u64, loss_key) field(i64, payload_bytes) field(i64, link)         \
  field(f64, price) /* of each transmission */

// `retransmit_ns` is -1 for a link that drops messages for good.
#define DWELL_LINK(field)                                                                        \
  field(i64, free_ns) field(i64, last_arrival_ns) field(i64, retransmit_ns)                      \
  field(i64, in_order) field(i64, n_held) field(i64, segment) field(i64, segment_end)

// A message that waits for earlier messages, or is being repeated (order.h): the event of its
// arrival, and its arrival time without the wait.
#define DWELL_HELD(field) field(i64, key) field(i64, link) field(i64, arrival_ns)

#define DWELL_EVENT(field) field(i64, at_ns) field(i64, key)

// A job that runs, by the virtual time at which it ends.
#define DWELL_RUNNING(field) field(f64, finish_ns) field(i64, key)

// A job that waits for cores, or a thread that waits for its turn.
#define DWELL_WAITING(field)                                                                     \
  field(i64, rank) field(i64, ready_ns) field(i64, key) field(f64, left_ns)

// A job in flight. `missing` counts the inputs that have not arrived. `beside_ns` is the work done
// while foreign threads interfered, measured by the clock `beside_ns` of its server; while the job
// runs, less the clock at its start.
#define DWELL_JOB(field)                                                                         \
  field(i64, ready_ns) field(i64, started_ns) field(i64, compute_ns) field(i64, network_ns)      \
  field(i64, next) field(f64, beside_ns) field(i32, site)                    \
  field(i32, missing)

// A cycle in flight. `live` counts its jobs and messages in flight. `is_lost` is one of `Loss`.
#define DWELL_SLOT(field)                                                                        \
  field(i64, cycle) field(i32, candidate) field(i32, pair) field(i32, live)                      \
  field(i32, sinks_left) field(i32, is_lost)

// `used_ns` is the integral of `used` of the job's server while the job ran; `above_ns` is the same
// integral for the server above. Both are kept only if cells share servers.
#define DWELL_LOG(field)                                                                         \
  field(i64, ready_ns) field(i64, start_ns) field(i64, end_ns) field(i64, work_ns)               \
  field(i64, used_ns) field(i64, above_ns)

// Metrics of cycles as known at the end of a window, or when a decision was due. `counted` cycles
// are not idle. `uncut_ms` is L95 without the limit `longest_ms` of the cell. `age_ms` is the mean
// over time of the age of the newest command, 0 unless the cell `weighs_age`. `price_per_hour` is
// the price of all transmissions since the release of the first of the cycles; 0 without prices.
#define DWELL_SEEN(field)                                                                        \
  field(i64, first_cycle) field(i64, cycles) field(i64, missed) field(i64, counted)              \
  field(f64, l95_ms) field(f64, uncut_ms) field(f64, age_ms) field(f64, price_per_hour)

// Numbers by which a built-in policy with the estimator `profile` decides (rules.h): the policy's
// parameters and the objective's, the placements of the cell, and the sums of `ATP` since its last
// decision. `Objective` has both a weight and a target under some names.
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
  field(f64, target_cloud) /* 0 if clouds have no own weight */                                  \
  field(f64, cap_ms) field(f64, cap_utilisation)

// A candidate: its expected metrics, its cumulative sum, and whether its toggled task is on a
// robot.
#define DWELL_OPTION(field)                                                                      \
  field(f64, l95_ms) field(f64, uncut_ms) field(f64, violation_rate) field(f64, sum)             \
  field(i64, on_robot)

// The decision at the end of a window.
#define DWELL_DECIDED(field)                                                                     \
  field(f64, delta_j) field(i64, dwell) field(i32, incumbent) field(i32, placement)              \
  field(i32, reason)

// Intervals in order, without overlap (see on_off_intervals.h). `passed` counts the begins and ends
// that are over.
#define DWELL_ON_OFF(field)                                                                      \
  field(Times, begin_ns) field(Times, end_ns) field(Times, levels) field(i64, count)             \
  field(i64, passed)

// The effect of one disturbance on a node.
#define DWELL_EFFECT(field)                                                                      \
  field(OnOffIntervals, intervals) field(i64, node) field(i64, down) field(Levels, threads)

// The effect of one disturbance on a link; `arriving` is the share of attempts that are not lost.
#define DWELL_FAULT(field)                                                                       \
  field(OnOffIntervals, intervals) field(i64, down) field(Levels, layers)                        \
  field(Shares, arriving) field(Shares, rate_mbps)

// A path of a random process, and the state of its sampling (draw.cpp). `location` is the value of
// a constant process, the lower end of a uniform distribution, or the mean of the normal; `spread`
// is the length of the uniform interval, or the deviation of the normal. A normal value is at least
// `least`. For a lognormal process, `correlation` is the correlation of the logarithms of
// consecutive cycles, `gain` is sqrt(1 - correlation^2), and `last` is the last standard normal,
// NaN before the first.
#define DWELL_PATH(field)                                                                        \
  field(Sfc64, stream) field(i64, kind) field(f64, location) field(f64, spread)                  \
  field(f64, least) field(f64, correlation) field(f64, gain) field(f64, last)

// The parts of cycles under one candidate (meter.cpp). `sources` has the source of each flow.
// `parts` has the part of each task and of each flow, -1 for none; row 0 describes the cycles, row
// 1 + i their shadows through candidate i. `shared` shows whether a shadow's flow starts at a task
// that it shares with the cycle.
#define DWELL_LAYOUT(field)                                                                      \
  field(i64, n_tasks) field(i64, n_flows) field(Times, sources) field(Times, parts)              \
  field(const i8*, shared)

// One row per cycle of a window: the candidate of the cycle; the instants at which its jobs became
// ready, its jobs completed and its messages arrived; the core time of its jobs; the instants at
// which they started. -1 marks future and unknown values. If there are shadows, the same columns
// follow for the cycle's shadow, with candidate -1 for a cycle without one.
#define DWELL_WINDOW(field) field(i64*, rows) field(i64, n) field(i64, width)

// The jobs of a node (jobs.cpp): `cores` of each candidate and task, 0 for a task on another node;
// cores of the node, and cores left by its background; the period; foreign threads next to jobs; the
// share of the time with bursts; mean cores that the cell's jobs used, and that foreign threads used,
// on a full node in the window (0 if it is not full).
#define DWELL_NODE_JOBS(field)                                                                   \
  field(i64, n_tasks) field(i64, n_flows) field(const f64*, cores) field(i64, is_fair)           \
  field(f64, n_cores) field(f64, spare) field(f64, period_ns) field(f64, foreign)                \
  field(f64, bursts) field(f64, own) field(f64, others)

// The times found: up to `most` per part, and the parts in the order in which they were found.
// If the caller wants demands instead of times, each part has a `cost`: for a job the ratio of its
// time alone to its core time, for a message its transmission time in nanoseconds. Each part also
// has the `link` on which messages wait, -1 for none, and the flag `repeats` of links that repeat
// messages and keep their order.
#define DWELL_FOUND(field)                                                                       \
  field(f64*, ms) field(i64*, count) field(i64*, order) field(i64, most) field(i64, n_parts)     \
  field(const f64*, cost) field(const i64*, link) field(const i64*, repeats)                     \
  field(const i64*, more_ns) /* patience beyond the limit, null for none */                      \
  field(i64, counted_ns) /* of earlier cycles: close of the last decision; else -1 */            \
  field(i64, passed_ns)  /* time since then */                                                   \
  field(Crossing*, crossings) field(i64, n_crossings)

// The values of a part from a single window: their number, and the sums of their places.
#define DWELL_CHUNK(field)                                                                       \
  field(i64, window) field(i64, cycles) field(i64, size)                                         \
  field(f64, larger) field(f64, smaller) field(f64, places)

// The values of a part (pools.cpp).
//
// Declared: `known` has `n_known` values, ascending; `likeness` is the mean correlation of two
// values within a stretch of `block` cycles. `guide` counts the declared values below each of equal
// parts of their range.
//
// Held: `size` values from row `first` of `held`, with the sums of their places; `chunks` are the
// windows of these values, `cycles` all cycles of the windows. `lasting` counts the cycles for
// which the values have deviated from the declared values. `measured` counts measured values,
// `last` is the window of the newest, `touched` the window in which the pool last stopped being as
// declared, or last received a value since. `changes` counts the changes of the held values.
//
// Python sets `asks` to receive the next window, and `doubts` while it tests the held values.
//
// The `run_` fields are the cycles and the sums of a run of windows with larger, or with smaller,
// values; 0 cycles for none. `before` has the `n_before` values, ascending, that were held before
// the run; 0 stands for the declared values.
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
  row(Forward, DWELL_FORWARD) row(Repeat, DWELL_REPEAT) row(Descent, DWELL_DESCENT)              \
  row(Chain, DWELL_CHAIN)                                                                        \
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

// Fixed tables, then state, then outputs: per cycle, per window, and optional logs. rows.py has the
// shapes.
#define DWELL_TABLES(table)                                                                      \
  table(Clock, clock) table(Cell, cells) table(Task, tasks) table(Flow, flows)                   \
  table(i32, outputs) table(i32, sampled) table(i32, sink_rates) table(i32, cell_servers) table(f64, capacity) table(Node, nodes)           \
  table(i32, site_of) table(i32, route) table(i64, back_ns) table(i8, shadow_parts)              \
  table(i64, after_ns) table(i64, hear_ns)                                                       \
  table(Hop, hops) table(Forward, forwards) table(Times, layers) table(Segment, segments) table(Rate, rates)              \
  table(Change, changes) table(f64, work) table(f64, switching)               \
  table(i8, tiers) table(i16, stamps)                                                            \
  table(Site, sites) table(Server, servers) table(Quota, quotas) table(Link, links)              \
  table(Event, events) table(i32, following) table(i32, days) table(Held, held)                  \
  table(Repeat, repeats)                                                                         \
  table(Running, running) table(Waiting, waiting)                                                \
  table(i32, dirty) table(i64, ready) table(Job, jobs) table(Slot, slots) table(i64, attempts)   \
  table(f64, own_ns) table(i64, soonest_ns) table(i64, ages) table(i64, values)                  \
  table(i64, forwarded) table(Chain, chains) table(Descent, descents)                            \
  table(Rule, rule) table(Option, options) table(f64, shown)                                     \
  table(i64, latency_ns) table(i64, compute_ns) table(i64, network_ns) table(i8, outcome)        \
  table(i64, late_copies) table(f64, paid)                                                       \
  table(i64, actuated_ns) table(i64, actuated_from) table(i64, actuated_newest)                  \
  table(f64, opened) table(f64, closed) table(Seen, seen) table(f64, shares)                     \
  table(f64, look_opened) table(f64, look_closed) table(Seen, looked) table(f64, look_shares)    \
  table(Decided, decided) table(f64, priced)                                                     \
  table(i64, shadow_bytes) table(Log, log) table(i8, log_outcome) table(i64, log_arrived)        \
  table(i64, log_taken)

// clang-format on

// A table and its number of rows, or of numbers.
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
