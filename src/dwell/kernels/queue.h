// The queue of events, by (time, key): sorted while it is short, a heap of four children beyond.
#pragma once

#include <algorithm>

#include "rows.h"

namespace dwell {

inline bool operator<(const Event& a, const Event& b) {
  return a.at_ns < b.at_ns || (a.at_ns == b.at_ns && a.key < b.key);
}

class Queue {
 public:
  Queue(Table<Event> events, const Clock& clock)
      : events_(events.rows),
        size_(clock.n_events),
        room_(events.size),
        heap_(clock.is_heap != 0) {}

  void save(Clock& clock) const {
    clock.n_events = size_;
    clock.is_heap = heap_;
  }

  bool is_empty() const { return size_ == 0; }
  bool has_room(i64 more) const { return size_ + more <= room_; }
  const Event& first() const { return heap_ ? events_[0] : events_[size_ - 1]; }

  // The caller has made sure of room.
  void push(i64 at_ns, i64 key) {
    if (!heap_ && size_ >= kLongest) turn_round();
    const Event event{at_ns, key};
    i64 i = size_++;
    if (heap_) {
      for (i64 parent; i > 0 && event < events_[parent = (i - 1) / 4]; i = parent) {
        events_[i] = events_[parent];
      }
    } else {
      // The first is last, so that what comes soon moves few.
      for (; i > 0 && events_[i - 1] < event; --i) events_[i] = events_[i - 1];
    }
    events_[i] = event;
  }

  void pop() {
    --size_;
    if (!heap_) return;
    const Event event = events_[size_];
    i64 i = 0;
    for (i64 child; (child = 4 * i + 1) < size_; i = child) {
      const i64 end = std::min(child + 4, size_);
      for (i64 other = child + 1; other < end; ++other) {
        if (events_[other] < events_[child]) child = other;
      }
      if (event < events_[child]) break;
      events_[i] = events_[child];
    }
    events_[i] = event;
    if (size_ == kShort) turn_round();
  }

 private:
  static constexpr i64 kLongest = 48, kShort = 16;

  // Makes a heap of what is sorted, or sorts a heap.
  [[gnu::noinline]] void turn_round() {
    if (heap_) {
      std::sort(events_, events_ + size_, [](const Event& a, const Event& b) { return b < a; });
    } else {
      std::reverse(events_, events_ + size_);
    }
    heap_ = !heap_;
  }

  Event* events_;
  i64 size_, room_;
  bool heap_;
};

}  // namespace dwell
