// Random numbers as functions of a key and counters, without state.
#pragma once

#include "rows.h"

namespace dwell {

// Uniform number in [0, 1), 53 bits, for one attempt to send the message of a cycle; cycles and
// attempts count from 0.
//
// The finaliser of splitmix64 (Steele, Lea and Flood 2014, DOI 10.1145/2660193.2660195) over a key
// and two counters: attempts need no table, and attempt a of cycle k is independent of earlier
// events.
inline f64 attempt_uniform(u64 key, i64 cycle, i64 attempt) {
  u64 z = key + static_cast<u64>(cycle + 1) * 0x9E3779B97F4A7C15u +
          static_cast<u64>(attempt + 1) * 0xD1B54A32D192ED03u;
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  z = z ^ (z >> 31);
  return static_cast<f64>(z >> 11) * 0x1p-53;
}

}  // namespace dwell
