// The model of peer-chain.yaml as a C++ event loop with a heap and a ziggurat of its own, and no
// generality at all: about the attainable limit.
//
//   g++ -O3 -march=native -std=c++17 cpp_loop.cpp -o cpp_loop; ./cpp_loop CYCLES
//
// Prints one line of JSON. Drawing, simulating and the windows' metrics are timed.

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <utility>
#include <vector>

// xoshiro256++, seeded by splitmix64
struct Rng {
    uint64_t s[4];

    explicit Rng(uint64_t seed) {
        for (auto& word : s) word = splitmix(seed);
    }

    static uint64_t splitmix(uint64_t& x) {
        uint64_t z = (x += 0x9e3779b97f4a7c15ULL);
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
        return z ^ (z >> 31);
    }

    static uint64_t rotl(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

    uint64_t next() {
        const uint64_t result = rotl(s[0] + s[3], 23) + s[0], t = s[1] << 17;
        s[2] ^= s[0];
        s[3] ^= s[1];
        s[1] ^= s[2];
        s[0] ^= s[3];
        s[2] ^= t;
        s[3] = rotl(s[3], 45);
        return result;
    }

    double uniform() { return (next() >> 11) * 0x1.0p-53; }
};

// Marsaglia and Tsang's ziggurat with 128 layers
static const double TAIL = 3.442619855899;
static double zig_x[129], zig_r[128];

static void zig_init() {
    const double area = 9.91256303526217e-3;
    double f = std::exp(-0.5 * TAIL * TAIL);
    zig_x[0] = area / f;
    zig_x[1] = TAIL;
    zig_x[128] = 0;
    for (int i = 2; i < 128; i++) {
        zig_x[i] = std::sqrt(-2 * std::log(area / zig_x[i - 1] + f));
        f = std::exp(-0.5 * zig_x[i] * zig_x[i]);
    }
    for (int i = 0; i < 128; i++) zig_r[i] = zig_x[i + 1] / zig_x[i];
}

static inline double normal(Rng& rng) {
    for (;;) {
        const uint64_t bits = rng.next();
        const double u = 2.0 * ((bits >> 11) * 0x1.0p-53) - 1.0;
        const int i = bits & 127;
        if (std::fabs(u) < zig_r[i]) return u * zig_x[i];
        if (i == 0) {
            double x, y;
            do {
                x = std::log(1 - rng.uniform()) / TAIL;
                y = std::log(1 - rng.uniform());
            } while (-2 * y < x * x);
            return u < 0 ? x - TAIL : TAIL - x;
        }
        const double x = u * zig_x[i];
        const double f0 = std::exp(-0.5 * (zig_x[i] * zig_x[i] - x * x));
        const double f1 = std::exp(-0.5 * (zig_x[i + 1] * zig_x[i + 1] - x * x));
        if (f1 + rng.uniform() * (f0 - f1) < 1.0) return x;
    }
}

struct Event {
    double t;
    uint32_t seq;
    uint16_t kind, pad;
    uint32_t cycle;
};

// A binary heap in a fixed array: (t, seq), the least on top
struct Heap {
    Event a[4096];
    int n = 0;

    static bool less(const Event& x, const Event& y) {
        return x.t < y.t || (x.t == y.t && x.seq < y.seq);
    }

    void push(const Event& e) {
        int i = n++;
        while (i) {
            const int parent = (i - 1) >> 1;
            if (!less(e, a[parent])) break;
            a[i] = a[parent];
            i = parent;
        }
        a[i] = e;
    }

    bool empty() const { return !n; }
    const Event& top() const { return a[0]; }

    void pop() {
        const Event e = a[--n];
        int i = 0;
        for (;;) {
            int child = 2 * i + 1;
            if (child >= n) break;
            if (child + 1 < n && less(a[child + 1], a[child])) child++;
            if (!less(a[child], e)) break;
            a[i] = a[child];
            i = child;
        }
        a[i] = e;
    }
};

// A node's queue of (task, cycle)
struct Ring {
    std::vector<std::pair<int, uint32_t>> items;
    size_t head = 0, n = 0;

    Ring() : items(4096) {}
    void put(int task, uint32_t cycle) { items[(head + n++) & 4095] = {task, cycle}; }
    std::pair<int, uint32_t> get() {
        n--;
        return items[head++ & 4095];
    }
};

// Kinds of events: RELEASE, or one of these plus the task
enum : uint16_t { RELEASE = 0, ARRIVE = 1, DONE = 10 };

int main(int argc, char** argv) {
    const uint32_t cycles = argc > 1 ? std::atoi(argv[1]) : 100000;
    const double period = 33, deadline = 33, sigma = 0.3;
    const int tasks = 4, window_cycles = 100;
    int place[4] = {0, 1, 1, 2};
    double mean[4] = {2, 8, 6, 2}, mu[4];
    for (int i = 0; i < 4; i++) mu[i] = std::log(mean[i]) - sigma * sigma / 2;
    zig_init();
    Rng rng(1);
    std::vector<double> latency(cycles);

    const std::clock_t cpu = std::clock();
    const auto wall = std::chrono::steady_clock::now();
    auto work = [&](int task) { return std::exp(mu[task] + sigma * normal(rng)); };
    auto delay = [&] { return std::max(0.2, 3 + normal(rng)); };
    static Heap heap;
    Ring queue[3];
    bool busy[3] = {false, false, false};
    uint32_t seq = 0;
    heap.push({0, seq++, RELEASE, 0, 0});
    while (!heap.empty()) {
        Event e = heap.top();
        heap.pop();
        int task = -1, node = -1;
        if (e.kind == RELEASE) {
            const uint32_t next = e.cycle + 1;
            if (next < cycles) heap.push({next * period, seq++, RELEASE, 0, next});
            task = 0;
            node = place[0];
        } else if (e.kind < DONE) {
            task = e.kind - ARRIVE;
            node = place[task];
        } else {
            int done = e.kind - DONE, on = place[done];
            if (done + 1 == tasks) {
                latency[e.cycle] = e.t - e.cycle * period;
            } else if (place[done + 1] == on) {
                queue[on].put(done + 1, e.cycle);
            } else {
                heap.push({e.t + delay(), seq++, (uint16_t)(ARRIVE + done + 1), 0, e.cycle});
            }
            if (queue[on].n) {
                auto next = queue[on].get();
                const double end = e.t + work(next.first);
                heap.push({end, seq++, (uint16_t)(DONE + next.first), 0, next.second});
            } else {
                busy[on] = false;
            }
        }
        if (task >= 0) {
            if (busy[node]) {
                queue[node].put(task, e.cycle);
            } else {
                busy[node] = true;
                heap.push({e.t + work(task), seq++, (uint16_t)(DONE + task), 0, e.cycle});
            }
        }
    }

    double p95 = 0, miss = 0;
    const uint32_t windows = cycles / window_cycles;
    std::vector<double> window(window_cycles);
    for (uint32_t i = 0; i < windows; i++) {
        std::copy_n(&latency[(size_t)i * window_cycles], window_cycles, window.begin());
        int missed = 0;
        for (double x : window) missed += x > deadline;
        miss += missed / (double)window_cycles;
        std::nth_element(window.begin(), window.begin() + 94, window.end());
        p95 += 0.95 * window[94] + 0.05 * *std::min_element(window.begin() + 95, window.end());
    }
    const std::chrono::duration<double> wall_s = std::chrono::steady_clock::now() - wall;
    const double cpu_s = (double)(std::clock() - cpu) / CLOCKS_PER_SEC;
    std::printf("{\"wall_s\": %.6f, \"cpu_s\": %.6f, \"p95\": %.9g, \"miss\": %.9g}\n",
                wall_s.count(), cpu_s, p95 / windows, miss / windows);
}
