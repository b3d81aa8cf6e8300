// Binary heaps of a server's jobs: running jobs, and jobs that wait for its cores.
#pragma once

#include "rows.h"

namespace dwell {

inline bool operator<(const Running& a, const Running& b) {
  return a.finish_ns < b.finish_ns || (a.finish_ns == b.finish_ns && a.key < b.key);
}

inline bool operator<(const Waiting& a, const Waiting& b) {
  if (a.rank != b.rank) return a.rank < b.rank;
  if (a.ready_ns != b.ready_ns) return a.ready_ns < b.ready_ns;
  return a.key < b.key;
}

// Puts a row into the free place `i` of a heap, and moves it towards the root past larger rows.
template <class Row>
i64 rise(Row* heap, i64 i, const Row& row) {
  while (i > 0) {
    const i64 parent = (i - 1) >> 1;
    if (heap[parent] < row) break;
    heap[i] = heap[parent];
    i = parent;
  }
  heap[i] = row;
  return i;
}

// Adds a row to a heap of n.
template <class Row>
void push(Row* heap, i64 n, const Row& row) {
  rise(heap, n, row);
}

// Removes row `at` from a heap of n; row 0 is the first.
template <class Row>
void pop(Row* heap, i64 n, i64 at = 0) {
  --n;
  if (at == n) return;
  const Row row = heap[n];
  i64 i = rise(heap, at, row);
  for (i64 child; (child = 2 * i + 1) < n; i = child) {
    if (child + 1 < n && heap[child + 1] < heap[child]) ++child;
    if (!(heap[child] < row)) break;
    heap[i] = heap[child];
  }
  heap[i] = row;
}

}  // namespace dwell
