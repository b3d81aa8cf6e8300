// The times of jobs and messages that the instants of a window's cycles show, by part: a task on a
// node, or a flow on a link.

#include <limits>

#include "export.h"
#include "rows.h"

namespace dwell {
namespace {

// A row a cycle of a window: the candidate that it went through, when its jobs became ready, when
// they completed, and when its messages arrived, -1 for what had not come; then, where there are
// shadows, the same of its shadow, the candidate being -1 where it has none.
struct Window {
  const i64* rows;
  i64 n, width;
};

// What cycles under one candidate go through: the source of each flow, then in row 0 for the cycles
// themselves, in row 1 + i for their shadows through candidate i, the part of each task and of each
// flow, -1 for none of their own, and whether a flow's source is shared with the cycle.
struct Layout {
  i64 n_tasks, n_flows;
  const i64* sources;
  const i64* parts;
  const i8* shared;
};

// The times found: up to `most` of each part, and the parts in the order in which they were found.
struct Found {
  f64* ms;
  i64* count;
  i64* order;
  i64 most, n_parts;
};

void add(Found& found, i64 part, f64 ms) {
  if (found.count[part] == 0) found.order[found.n_parts++] = part;
  found.ms[part * found.most + found.count[part]++] = ms;
}

// Adds what lies between two instants. What has not come is lost if it began before the limit; if
// it began later, or never, nothing is known of it.
void add_span(Found& found, i64 part, i64 begin_ns, i64 end_ns, i64 limit_ns) {
  if (begin_ns >= 0 && end_ns >= 0) {
    add(found, part, static_cast<f64>(end_ns - begin_ns) / 1e6);
  } else if (begin_ns >= 0 && begin_ns < limit_ns) {
    add(found, part, std::numeric_limits<f64>::infinity());
  }
}

// The next candidate that cycles under `active` were also sent through; -1 if there is none.
i64 next_other(const Window& window, i64 shadow, i64 active, i64 after) {
  i64 next = -1;
  for (i64 i = 0; i < window.n; ++i) {
    const i64* row = window.rows + i * window.width;
    const i64 other = row[shadow];
    if (row[0] == active && other > after && (next < 0 || other < next)) next = other;
  }
  return next;
}

}  // namespace
}  // namespace dwell

using namespace dwell;

// Adds the times of the cycles under one candidate, part after part, then those of their shadows by
// candidate.
DWELL_EXPORT void dwell_meter(const Layout* layout, const Window* window, i64 active, i64 limit_ns,
                              Found* found) noexcept {
  const i64 n_tasks = layout->n_tasks, n_flows = layout->n_flows;
  const i64 shadow = 1 + 2 * n_tasks + n_flows;  // where its columns begin
  i64 other = -1;
  do {
    const i64 begin = other < 0 ? 0 : shadow;
    const i64* parts = layout->parts + (other + 1) * (n_tasks + n_flows);
    const i8* shared = layout->shared + (other + 1) * n_flows;
    for (i64 column = 0; column < n_tasks + n_flows; ++column) {
      const i64 part = parts[column], flow = column - n_tasks;
      if (part < 0) continue;
      const i64 source = flow < 0 ? 0 : layout->sources[flow];
      for (i64 i = 0; i < window->n; ++i) {
        const i64* cycle = window->rows + i * window->width;
        if (cycle[0] != active || (begin > 0 && cycle[begin] != other)) continue;
        const i64 *ready_ns = cycle + begin + 1, *end_ns = ready_ns + n_tasks;
        if (flow < 0) {
          add_span(*found, part, ready_ns[column], end_ns[column], limit_ns);
        } else {
          const i64* sent_ns = shared[flow] ? cycle + 1 + n_tasks : end_ns;
          add_span(*found, part, sent_ns[source], end_ns[n_tasks + flow], limit_ns);
        }
      }
    }
    other = window->width > shadow ? next_other(*window, shadow, active, other) : -1;
  } while (other >= 0);
}
