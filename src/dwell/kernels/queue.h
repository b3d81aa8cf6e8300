// The queue of events, by (time, key): sorted while it is short, a calendar beyond.
//
// A calendar has a sorted list of events for each day; days a year apart share a list. With about
// one event per day, the time to add an event or to take the first does not grow with their number
// (R. Brown, 1988, DOI 10.1145/63039.63045).
#pragma once

#include <algorithm>

#include "rows.h"

namespace dwell {

inline bool operator<(const Event& a, const Event& b) {
  return a.at_ns < b.at_ns || (a.at_ns == b.at_ns && a.key < b.key);
}

class Queue {
 public:
  Queue(Table<Event> events, Table<i32> following, Table<i32> days, const Clock& clock)
      : events_(events.rows),
        size_(clock.n_events),
        room_(events.size),
        is_calendar_(clock.is_calendar != 0),
        following_(following.rows),
        days_(days.rows),
        n_days_(days.size),
        day_bits_(clock.day_bits),
        first_(clock.first_event),
        used_(clock.used_events),
        free_(clock.free_event) {}

  void save(Clock& clock) const {
    clock.n_events = size_;
    clock.is_calendar = is_calendar_;
    clock.first_event = first_;
    clock.used_events = used_;
    clock.free_event = free_;
  }

  bool is_empty() const { return size_ == 0; }
  bool has_room(i64 more) const { return size_ + more <= room_; }
  const Event& first() const { return events_[is_calendar_ ? first_ : size_ - 1]; }

  // The caller ensures room.
  void push(i64 at_ns, i64 key) {
    const Event event{at_ns, key};
    if (!is_calendar_ && size_ >= kLongest) open_calendar();
    if (is_calendar_) {
      enter(event);
    } else {
      // The first event is last: an event that is due soon moves few others.
      i64 i = size_;
      for (; i > 0 && events_[i - 1] < event; --i) events_[i] = events_[i - 1];
      events_[i] = event;
    }
    ++size_;
  }

  void pop() {
    --size_;
    if (is_calendar_) strike();
  }

 private:
  static constexpr i64 kLongest = 48, kShort = 16;
  static constexpr i32 kNone = -1;

  i64 day_of(i64 row) const { return events_[row].at_ns >> day_bits_; }
  i32& list_of(i64 day) const { return days_[day & (n_days_ - 1)]; }

  // Enters the row of an event into the list of its day, behind equal events: the first event stays
  // the first of its list.
  void link(i64 row) {
    i32* at = &list_of(day_of(row));
    while (*at != kNone && !(events_[row] < events_[*at])) at = &following_[*at];
    following_[row] = *at;
    *at = static_cast<i32>(row);
  }

  // Enters an event into the calendar, in a freed or unused row.
  void enter(const Event& event) {
    i64 row = free_;
    if (row == kNone) {
      row = used_++;
    } else {
      free_ = following_[row];
    }
    events_[row] = event;
    link(row);
    if (event < events_[first_]) first_ = row;
  }

  // Removes the first event from the calendar, and finds the next.
  void strike() {
    const i64 day = day_of(first_);
    list_of(day) = following_[first_];
    following_[first_] = static_cast<i32>(free_);
    free_ = first_;
    if (size_ == kShort) {
      close_calendar();
    } else {
      find_first(day);
    }
  }

  // Finds the first event, from a day on.
  void find_first(i64 day) {
    for (const i64 end = day + n_days_; day < end; ++day) {
      first_ = list_of(day);
      if (first_ != kNone && day_of(first_) == day) return;
    }
    // No event within a year: take the first of all lists.
    first_ = kNone;
    for (const i32* list = days_; list < days_ + n_days_; ++list) {
      if (*list != kNone && (first_ == kNone || events_[*list] < events_[first_])) first_ = *list;
    }
  }

  [[gnu::noinline]] void open_calendar() {
    is_calendar_ = true;
    first_ = size_ - 1;
    used_ = size_;
    free_ = kNone;
    std::fill_n(days_, n_days_, kNone);
    for (i64 row = first_; row >= 0; --row) link(row);
  }

  [[gnu::noinline]] void close_calendar() {
    is_calendar_ = false;
    Event sorted[kShort];
    Event* end = sorted;
    for (const i32* list = days_; list < days_ + n_days_; ++list) {
      for (i32 row = *list; row != kNone; row = following_[row]) *end++ = events_[row];
    }
    std::sort(sorted, end, [](const Event& a, const Event& b) { return b < a; });
    std::copy(sorted, end, events_);
  }

  Event* events_;
  i64 size_, room_;
  bool is_calendar_;
  i32 *following_, *days_;
  i64 n_days_, day_bits_;
  i64 first_, used_, free_;  // rows; `free_` starts the list of freed rows
};

}  // namespace dwell
