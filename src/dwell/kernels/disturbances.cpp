// Changes of nodes and links: the disturbances of each, merged in time.

#include <algorithm>
#include <cstdint>
#include <utility>

#include "export.h"
#include "on_off_intervals.h"

namespace dwell {
namespace {

struct NodeState {
  int64_t threads;
  int64_t down;  // number of effects that keep it down
};

bool before(const NodeEffect& one, const NodeEffect& other) noexcept {
  const int64_t at_ns = next_ns(one.intervals);
  const int64_t other_ns = next_ns(other.intervals);
  return at_ns != other_ns ? at_ns < other_ns : one.node < other.node;
}

// Moves the effect at i of a binary heap down until no effect below it changes sooner.
void sift_down(NodeEffect** heap, int64_t count, int64_t i) noexcept {
  for (int64_t below = 2 * i + 1; below < count; below = 2 * i + 1) {
    if (below + 1 < count && before(*heap[below + 1], *heap[below])) ++below;
    if (!before(*heap[below], *heap[i])) return;
    std::swap(heap[i], heap[below]);
    i = below;
  }
}

}  // namespace

// Merges the effects of all nodes up to an instant; returns the number of changes.
DWELL_EXPORT int64_t dwell_node_changes(NodeEffect** effects, int64_t count, int64_t last_ns,
                                        NodeState* nodes, Change* changes) noexcept {
  for (int64_t i = count / 2; i-- > 0;) sift_down(effects, count, i);
  int64_t made = 0;
  while (count > 0 && next_ns(effects[0]->intervals) <= last_ns) {
    NodeEffect& next = *effects[0];
    const int64_t at_ns = next_ns(next.intervals);
    const int64_t sign = is_on(next.intervals) ? -1 : 1;
    NodeState& state = nodes[next.node];
    state.threads += sign * next.threads[level(next.intervals)];
    state.down += sign * next.down;
    // Several changes of a node at one instant give one row, with the last state.
    const bool again =
        made > 0 && changes[made - 1].at_ns == at_ns && changes[made - 1].node == next.node;
    made += again ? 0 : 1;
    changes[made - 1] = {at_ns, next.node, state.threads, state.down > 0 ? 1 : 0};
    ++next.intervals.passed;
    sift_down(effects, count, 0);
  }
  return made;
}

// Merges the faults of one link, given its undisturbed state as the first segment; returns the
// number of segments.
DWELL_EXPORT int64_t dwell_link_segments(LinkFault* faults, int64_t count, Segment* segments,
                                         Rate* rates) noexcept {
  const Segment own = segments[0];
  const Rate own_rate = rates[0];
  int64_t made = 0;
  for (int64_t at_ns = 0; at_ns != kAtNoTime;) {
    Segment segment = own;
    segment.at_ns = at_ns;
    double rate_mbps = own_rate.rate_mbps;
    double arriving = 1.0 - own_rate.loss;
    int64_t change_ns = kAtNoTime;
    for (int64_t i = 0; i < count; ++i) {
      LinkFault& fault = faults[i];
      OnOffIntervals& intervals = fault.intervals;
      while (next_ns(intervals) <= at_ns) ++intervals.passed;
      change_ns = std::min(change_ns, next_ns(intervals));
      if (!is_on(intervals)) continue;
      const int64_t strength = level(intervals);
      segment.is_down |= fault.down;
      segment.layers |= fault.layers[strength];
      arriving *= fault.arriving[strength];
      rate_mbps = std::min(rate_mbps, fault.rate_mbps[strength]);
    }
    segments[made] = segment;
    rates[made] = {rate_mbps, 1.0 - arriving};
    ++made;
    at_ns = change_ns;
  }
  return made;
}

}  // namespace dwell
