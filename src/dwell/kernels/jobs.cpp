// Waits of a window's jobs, and foreign threads on their nodes.

#include <algorithm>
#include <cmath>

#include "codes.h"
#include "export.h"
#include "rows.h"

namespace dwell {

// A completed job; `row` and `task` are its place in the window.
struct RanJob {
  f64 start_ns, end_ns, alone_ns, cores;
  f64 threads, slowed;  // foreign threads next to it; its duration over its time alone
  f64 used, above;      // mean threads of jobs on its server, and of jobs that go before it
  i64 row, task;

  f64 taken_ns() const { return std::max(end_ns - start_ns, 1.0); }
};

// An instant at which a job begins or ends, the cores that jobs use from then on, and the integral
// until then.
struct CoreUse {
  f64 at_ns, used, area;
  i64 number;  // in the order of jobs: all begins, then all ends
};

namespace {

struct Jobs {
  RanJob* first;
  i64 n;

  RanJob* begin() const { return first; }
  RanJob* end() const { return first + n; }
};

struct Uses {
  CoreUse* first;
  i64 n;
};

// Least typical wait of a task's jobs, as a share of their time alone; fewest jobs of a task.
constexpr f64 kLeastWait = 0.05;
constexpr i64 kJobs = 3;
// Least duration of a slowed job over its time alone; least share of a task's jobs that is "most".
constexpr f64 kSlowed = 1.02, kMost = 0.9;
// Deviations that show a change within a window; fewest values for this test.
constexpr f64 kChanged = 5.0;
constexpr i64 kLeast = 36;

// Without this comparison clang's std::sort of numbers calls the C++ library, which is not linked.
constexpr auto kIsLess = [](f64 one, f64 other) { return one < other; };

f64 median(f64* values, i64 n) {
  f64* middle = values + n / 2;
  std::nth_element(values, middle, values + n, kIsLess);
  if (n % 2 != 0) return *middle;
  return (*std::max_element(values, middle) + *middle) / 2.0;
}

// Whether the median wait of jobs exceeds `kLeastWait` of their median time alone.
template <class Taken>
bool is_longer(const RanJob* jobs, i64 n, f64* scratch, Taken taken_ns) {
  f64 longer_ns = 0.0, alone_ns = 0.0;
  for (i64 i = 0; i < n; ++i) {
    longer_ns += taken_ns(jobs[i]) - jobs[i].alone_ns;
    alone_ns += jobs[i].alone_ns;
  }
  // A sum is faster than a median: if most jobs waited, so did all jobs together.
  if (longer_ns <= kLeastWait / 4 * alone_ns) return false;
  for (i64 i = 0; i < n; ++i) scratch[i] = taken_ns(jobs[i]) - jobs[i].alone_ns;
  const f64 middle_ns = median(scratch, n);
  for (i64 i = 0; i < n; ++i) scratch[i] = jobs[i].alone_ns;
  return middle_ns > kLeastWait * median(scratch, n);
}

// Cores that jobs use over time; each begin or end of a job starts a new row.
Uses uses_of(Jobs jobs, CoreUse* out) {
  for (i64 i = 0; i < jobs.n; ++i) {
    const RanJob& job = jobs.first[i];
    out[i] = {job.start_ns, job.cores, 0.0, i};
    out[jobs.n + i] = {job.end_ns, -job.cores, 0.0, jobs.n + i};
  }
  const Uses uses{out, 2 * jobs.n};
  std::sort(out, out + uses.n, [](const CoreUse& one, const CoreUse& other) {
    return one.at_ns != other.at_ns ? one.at_ns < other.at_ns : one.number < other.number;
  });
  for (i64 i = 1; i < uses.n; ++i) out[i].used += out[i - 1].used;
  return uses;
}

// Integrates a rate that is constant between successive instants.
template <class Rate>
void integrate(Uses uses, Rate rate) {
  CoreUse* use = uses.first;
  for (i64 i = 1; i < uses.n; ++i) {
    use[i].area = use[i - 1].area + rate(use[i - 1].used) * (use[i].at_ns - use[i - 1].at_ns);
  }
}

f64 area_until(Uses uses, f64 at_ns) {
  const CoreUse* after =
      std::upper_bound(uses.first, uses.first + uses.n, at_ns,
                       [](f64 at, const CoreUse& use) { return at < use.at_ns; });
  if (after == uses.first) return after->area;
  const CoreUse& use = after[-1];
  if (after == uses.first + uses.n || use.at_ns == at_ns) return use.area;
  const f64 slope = (after->area - use.area) / (after->at_ns - use.at_ns);
  return slope * (at_ns - use.at_ns) + use.area;
}

f64 area_during(Uses uses, const RanJob& job) {
  return area_until(uses, job.end_ns) - area_until(uses, job.start_ns);
}

// Mean cores that the jobs of `uses` used while a job ran; the job itself counts if it is included.
f64 used_beside(Uses uses, const RanJob& job) {
  return uses.n == 0 ? 0.0 : area_during(uses, job) / job.taken_ns();
}

// Number of columns of a cycle; the columns of its shadow follow.
i64 width_of(const NodeJobs& node) { return 1 + 4 * node.n_tasks + node.n_flows; }

// Writes the job of a task to `out`, if its duration and core time are known.
bool add_job(const NodeJobs& node, const Window& window, i64 begin, i64 row, i64 task,
             RanJob& out) {
  const i64* cycle = window.rows + row * window.width + begin;
  const f64 cores = cycle[0] < 0 ? 0.0 : node.cores[cycle[0] * node.n_tasks + task];
  const i64* end_ns = cycle + 1 + node.n_tasks + task;
  const i64* work_ns = end_ns + node.n_tasks + node.n_flows;
  const i64* start_ns = work_ns + node.n_tasks;
  if (cores == 0.0 || *end_ns < 0 || *work_ns <= 0 || *start_ns < 0) return false;
  const f64 alone_ns = static_cast<f64>(*work_ns) / cores;
  const f64 begun = static_cast<f64>(*start_ns), ended = static_cast<f64>(*end_ns);
  out = {begun, ended, alone_ns, cores, 0, 0, 0, 0, row, task};
  return true;
}

bool runs_on(const NodeJobs& node, i64 candidate) {
  const f64* cores = node.cores + candidate * node.n_tasks;
  return std::any_of(cores, cores + node.n_tasks, [](f64 one) { return one > 0.0; });
}

// Mean cores of a full node that jobs of earlier cycles used, because a task has a backlog: no job
// of the window completed. 0 without such a task.
f64 used_before(const NodeJobs& node, const Window& window) {
  if (node.own == 0.0) return 0.0;
  i64 known_ns = 0;
  bool has_backlog = false;
  for (i64 begin = 0; begin < window.width; begin += width_of(node)) {
    for (i64 task = 0; task < node.n_tasks; ++task) {
      i64 due = 0, completed = 0;
      for (i64 i = 0; i < window.n; ++i) {
        const i64* cycle = window.rows + i * window.width + begin;
        if (cycle[0] < 0 || node.cores[cycle[0] * node.n_tasks + task] == 0.0) continue;
        const i64* end_ns = cycle + 1 + node.n_tasks + task;
        due += *end_ns != kNotDue ? 1 : 0;
        if (*end_ns < 0) continue;
        completed += 1;
        known_ns += std::max<i64>(end_ns[node.n_tasks + node.n_flows], 0);
      }
      has_backlog |= begin == 0 && due > 0 && completed == 0;
    }
  }
  if (!has_backlog) return 0.0;
  const f64 span_ns = static_cast<f64>(window.n) * node.period_ns;
  return std::max(node.own - static_cast<f64>(known_ns) / span_ns, 0.0);
}

// The lowest candidate above `after` in the column `begin` of cycles, or of shadows; -1 for none.
i64 next_candidate(const Window& window, i64 begin, i64 after) {
  i64 next = -1;
  for (i64 i = 0; i < window.n; ++i) {
    const i64 one = window.rows[i * window.width + begin];
    if (one > after && (next < 0 || one < next)) next = one;
  }
  return next;
}

// Adds waits to the work of a node's jobs, for the tasks whose typical job waited; the cycles are
// under one candidate.
[[gnu::noinline]] void add_waits(const NodeJobs& node, const Window& window, i64 candidate,
                                 RanJob* jobs) {
  const i64 room = window.n * node.n_tasks;
  f64* scratch = reinterpret_cast<f64*>(jobs + room);
  CoreUse* uses_out = reinterpret_cast<CoreUse*>(scratch + room);
  Jobs all{jobs, 0};
  bool any = false;
  const auto each_task = [&](auto&& look) {
    for (RanJob* first = all.begin(); first != all.end();) {
      RanJob* last = first;
      while (last != all.end() && last->task == first->task) ++last;
      look(first, last - first);
      first = last;
    }
  };
  for (i64 task = 0; task < node.n_tasks; ++task) {
    for (i64 row = 0; row < window.n; ++row) {
      if (window.rows[row * window.width] != candidate) continue;
      all.n += add_job(node, window, 0, row, task, jobs[all.n]) ? 1 : 0;
    }
  }
  const auto took_ns = [](const RanJob& job) { return job.end_ns - job.start_ns; };
  // The jobs of most tasks took no longer than their core time; skip the rest then.
  each_task([&](const RanJob* first, i64 n) {
    any |= n >= kJobs && is_longer(first, n, scratch, took_ns);
  });
  if (!any) return;
  const Uses uses = uses_of(all, uses_out);
  const f64 spare = std::max(node.spare - used_before(node, window), 0.0);
  // Share of its wanted cores that a job gets if it waits only for other running threads.
  integrate(uses,
            [&](f64 used) { return std::min(spare / std::max(used + node.foreign, 1e-9), 1.0); });
  const auto had_ns = [&](const RanJob& job) { return area_during(uses, job); };
  each_task([&](const RanJob* first, i64 n) {
    if (n < kJobs || !is_longer(first, n, scratch, took_ns)) return;
    if (!is_longer(first, n, scratch, had_ns)) return;
    for (const RanJob* job = first; job != first + n; ++job) {
      const i64 column = 1 + 2 * node.n_tasks + node.n_flows + job->task;
      const f64 work_ns = std::rint(std::max(had_ns(*job), job->alone_ns) * job->cores);
      window.rows[job->row * window.width + column] = static_cast<i64>(work_ns);
    }
  });
}

// The first of a window's values after its last change; 0 without a change. A change is sought
// after each quarter of the values, by the mean ranks before and after; infinite values rank last.
i64 newest(const f64* values, i64 n, f64* scratch) {
  if (n < kLeast) return 0;
  std::copy(values, values + n, scratch);
  std::sort(scratch, scratch + n, kIsLess);
  const i64 ends[] = {n / 4, n / 2, 3 * n / 4};
  i64 before[] = {0, 0, 0}, all = 0;
  for (i64 i = 0; i < n; ++i) {
    const auto [low, high] = std::equal_range(scratch, scratch + n, values[i]);
    const i64 rank = (low - scratch) + (high - scratch);
    all += rank;
    for (i64 at = 0; at < 3; ++at) before[at] += i < ends[at] ? rank : 0;
  }
  i64 best = 0;
  f64 most = -1.0;
  for (i64 at = 0; at < 3; ++at) {
    const f64 first = static_cast<f64>(ends[at]), rest = static_cast<f64>(n - ends[at]);
    const f64 gap =
        static_cast<f64>(before[at]) / first - static_cast<f64>(all - before[at]) / rest;
    // Twice the ranks have four times the variance of a uniform distribution over them.
    const f64 off =
        std::abs(gap) / (static_cast<f64>(n) * std::sqrt((1.0 / first + 1.0 / rest) / 3));
    if (off > most) {
      most = off;
      best = ends[at];
    }
  }
  return most >= kChanged ? best : 0;
}

// The jobs on the CPU of a node, of all cycles or of all shadows, candidate after candidate; with
// the mean number of threads of all cells next to each, if logged.
Jobs jobs_on(const NodeJobs& node, const Window& window, i64 begin, const i64* beside, RanJob* out,
             bool* any) {
  const i64 parts = window.width > width_of(node) ? 2 : 1;
  Jobs jobs{out, 0};
  for (i64 one = -1; (one = next_candidate(window, begin, one)) >= 0;) {
    *any |= runs_on(node, one);
    for (i64 row = 0; row < window.n; ++row) {
      if (window.rows[row * window.width + begin] != one) continue;
      for (i64 task = 0; task < node.n_tasks; ++task) {
        RanJob& job = out[jobs.n];
        if (!add_job(node, window, begin, row, task, job)) continue;
        if (beside != nullptr) {
          const i64* of_job =
              beside + 2 * ((row * parts + (begin > 0 ? 1 : 0)) * node.n_tasks + task);
          job.used = static_cast<f64>(of_job[0]) / job.taken_ns();
          job.above = static_cast<f64>(of_job[1]) / job.taken_ns();
        }
        job.row = jobs.n++;
      }
    }
  }
  return jobs;
}

// Foreign threads that share the cores left by own jobs with shadow jobs.
f64 threads_behind(f64 slowed, f64 spare, f64 mine, f64 own) {
  f64 threads = std::max(slowed * std::max(spare - own, 0.0) - mine, 0.0);
  for (i64 i = 0; i < 2; ++i) {
    const f64 load = own + threads;
    const f64 left = load <= spare ? spare - own : spare * threads / std::max(load, 1e-9);
    threads = std::max(slowed * left - mine, 0.0);
  }
  return threads;
}

// The same if cells share the node, whose jobs may fill it: if all threads are slowed, own jobs
// leave c s / (own + s) cores to s foreign threads.
f64 threads_behind_all(f64 slowed, f64 spare, f64 mine, f64 own) {
  const f64 free = slowed * (spare - own) - mine;
  if (free > 0.0 && own + free <= spare) return free;
  const f64 half = (slowed * spare - own - mine) / 2;
  return std::max(half + std::sqrt(std::max(half * half - own * mine, 0.0)), 0.0);
}

// Keeps the jobs of each task since the task's last change. If most jobs of some tasks are slowed,
// keeps only these tasks and returns true.
bool keep_newest(Jobs& jobs, f64* scratch) {
  std::sort(jobs.begin(), jobs.end(), [](const RanJob& one, const RanJob& other) {
    if (one.task != other.task) return one.task < other.task;
    return one.end_ns != other.end_ns ? one.end_ns < other.end_ns : one.row < other.row;
  });
  const auto sweep = [&](bool slowed_only, bool keeps) {
    i64 kept = 0;
    for (RanJob* first = jobs.begin(); first != jobs.end();) {
      RanJob* last = first;
      i64 n = 0, slowed = 0;
      for (; last != jobs.end() && last->task == first->task; ++last) scratch[n++] = last->threads;
      first += newest(scratch, n, scratch + n);
      n = last - first;
      for (const RanJob* job = first; job != last; ++job) slowed += job->slowed > kSlowed ? 1 : 0;
      if (!slowed_only || static_cast<f64>(slowed) / static_cast<f64>(n) >= kMost) {
        if (keeps) std::copy(first, last, jobs.first + kept);
        kept += n;
      }
      first = last;
    }
    return kept;
  };
  const bool any = sweep(true, false) > 0;
  jobs.n = sweep(any, true);
  return any;
}

}  // namespace
}  // namespace dwell

using namespace dwell;

// Copies a window, and adds waits to the work of its own jobs on some nodes.
DWELL_EXPORT void dwell_add_waits(const NodeJobs* nodes, i64 n_nodes, const Window* window,
                                  RanJob* scratch, const Window* out) noexcept {
  std::copy(window->rows, window->rows + window->n * window->width, out->rows);
  for (i64 one = -1; (one = next_candidate(*out, 0, one)) >= 0;) {
    for (i64 i = 0; i < n_nodes; ++i) {
      if (runs_on(nodes[i], one)) add_waits(nodes[i], *out, one, scratch);
    }
  }
}

// Estimates from the jobs on a node the number of foreign threads since the last change, and its
// standard error, into `out`. Returns 0 if there are too few jobs, 2 if most jobs of a task are
// slowed, else 1. `beside` is the output of `dwell_logged_window` for a shared node, else null.
DWELL_EXPORT i64 dwell_level(const NodeJobs* node, const Window* window, const i64* beside,
                             i64 shadows, RanJob* scratch, f64* out) noexcept {
  const i64 room = window->n * node->n_tasks;
  RanJob* behind = scratch + room;
  CoreUse* uses_out = reinterpret_cast<CoreUse*>(behind + room);
  f64* values = reinterpret_cast<f64*>(uses_out + 4 * room);
  bool has_own = false;
  const Jobs own = jobs_on(*node, *window, 0, beside, scratch, &has_own);
  Jobs jobs = own;
  bool any = false;
  const bool is_behind = own.n < kJobs;
  const bool counts = node->is_fair != 0 && beside == nullptr;
  const f64 earlier = counts ? used_before(*node, *window) : 0.0;
  const f64 left = std::max(node->spare - earlier, 0.0);
  if (is_behind) {
    if (shadows == 0 || window->width <= width_of(*node)) return 0;
    jobs = jobs_on(*node, *window, width_of(*node), beside, behind, &any);
    if (jobs.n < kJobs) return 0;
  }
  const auto same = [](f64 used) { return used; };
  Uses uses{uses_out, 0}, before{uses_out + 2 * room, 0};
  if (counts) {
    integrate(uses = uses_of(jobs, uses_out), same);
    if (is_behind) integrate(before = uses_of(own, uses_out + 2 * room), same);
    has_own = has_own && is_behind;
  } else {
    has_own = node->is_fair != 0 && is_behind;
  }
  for (RanJob& job : jobs) {
    job.slowed = job.taken_ns() / job.alone_ns;
    if (counts) {
      job.used = used_beside(uses, job);
      job.above = used_beside(before, job);
    }
    const f64 mine = node->is_fair != 0 ? job.used : node->n_cores;
    const auto of_shadow = beside == nullptr ? threads_behind : threads_behind_all;
    job.threads =
        has_own ? of_shadow(job.slowed, left, mine, job.above) : job.slowed * node->spare - mine;
  }
  const bool is_slowed = keep_newest(jobs, values);
  for (i64 i = 0; i < jobs.n; ++i) values[i] = jobs.first[i].threads;
  std::sort(values, values + jobs.n, kIsLess);
  // The median of the jobs outside bursts; they have the smaller values, because bursts add
  // threads.
  const f64 place = (1.0 - node->bursts) / 2;
  const f64 off = std::sqrt(place * (1.0 - place) / static_cast<f64>(jobs.n));
  const auto at = [&](f64 share) {
    return values[static_cast<i64>(std::rint(share * static_cast<f64>(jobs.n - 1)))];
  };
  out[0] = at(place);
  out[1] = (at(std::min(place + off, 1.0)) - at(std::max(place - off, 0.0))) / 2;
  // The threads are foreign or of jobs of earlier cycles; both get the same cores per thread.
  if (!is_behind && earlier > 0.0) {
    const f64 share = node->others / (node->others + earlier);
    out[0] *= share;
    out[1] *= share;
  }
  return is_slowed ? 2 : 1;
}

// Returns the flaws of a window as a sum: 1 if an own job that began before the limit is
// unfinished, 2 if the work of a completed own job is unknown, 4 for a completed shadow job, 8 if
// its cycles have several candidates.
DWELL_EXPORT i64 dwell_unknown(i64 n_tasks, i64 n_flows, const Window* window,
                               i64 limit_ns) noexcept {
  i64 found = 0;
  const i64 width = 1 + 4 * n_tasks + n_flows;
  for (i64 i = 0; i < window->n; ++i) {
    if (window->rows[i * window->width] != window->rows[0]) found |= 8;
    for (i64 begin = 0; begin < window->width; begin += width) {
      const i64* ready_ns = window->rows + i * window->width + begin + 1;
      const i64 *end_ns = ready_ns + n_tasks, *work_ns = end_ns + n_tasks + n_flows;
      for (i64 task = 0; task < n_tasks; ++task) {
        const bool is_lost = end_ns[task] < 0 && ready_ns[task] >= 0 && ready_ns[task] < limit_ns;
        if (is_lost && begin == 0) found |= 1;
        if (end_ns[task] >= 0 && work_ns[task] < 0) found |= begin == 0 ? 2 : 4;
      }
    }
  }
  return found;
}
