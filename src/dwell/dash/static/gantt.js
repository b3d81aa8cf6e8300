// The jobs of a few cycles by task and node, on the time line of the strips.

import { fitted, leftOf, RIGHT } from "./charts.js";
import { draw, number, say } from "./dom.js";

const ROW = 18;

export const gantt = (root, cell, page, { jobs, cycles, origin_s }) => {
  const plot = root.querySelector(".plot");
  const rows = new Map();
  for (const { name: node } of cell.nodes)
    for (const { name: task, on } of cell.tasks)
      if (on.includes(node)) rows.set(`${task}@${node}`, rows.size);
  const width = Math.max(plot.clientWidth, 200);
  const left = leftOf(page.described, width);
  const [begin, end] = page.view;
  // Jobs have times in ms since the first release in view; the time line counts seconds or cycles.
  const [origin, each] = cell.unit === "cycle" ? [cycles[0]?.cycle ?? 0, cell.period_ms] : [origin_s, 1000];
  const x = (ms) => left + ((origin + ms / each - begin) / (end - begin)) * (width - left - RIGHT);
  const inside = (at) => at >= left - 0.5 && at <= width - RIGHT + 0.5;
  const clipped = (at) => Math.min(Math.max(at, left), width - RIGHT);
  const last = (end - origin) * each;
  const height = rows.size * ROW + 24;
  const svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img" });
  const missed = cycles.filter((cycle) => cycle.missed).map(({ cycle }) => cycle);
  svg.append(draw("title", { text: `${jobs.length} jobs of ${cycles.length} cycles; missed: ${missed.join(", ") || "none"}` }));
  const period = x(cell.period_ms) - x(0);
  for (const cycle of cycles) {
    const at = x(cycle.release_ms);
    const due = x(cycle.release_ms + cell.deadline_ms);
    if (inside(at)) svg.append(draw("line", { class: "release", x1: at, y1: 14, x2: at, y2: height - 8 }));
    if (inside(due)) svg.append(draw("line", { class: "due", x1: due, y1: 14, x2: due, y2: height - 8 }));
    if (period > 34 && inside(at) && at + 34 < width) svg.append(draw("text", { x: at + 3, y: 11, text: `${cycle.cycle}${cycle.missed ? " ×" : ""}` }));
  }
  for (const [name, row] of rows) {
    const text = fitted(name, left - 8);
    const label = draw("text", { class: "muted", x: left - 6, y: 18 + row * ROW + 12, "text-anchor": "end", text });
    if (text !== name) label.append(draw("title", { text: name }));
    svg.append(label);
  }
  const done = new Map(cycles.map((cycle) => [cycle.cycle, cycle.latency_ms === null ? null : cycle.release_ms + cycle.latency_ms]));
  for (const job of jobs) {
    const y = 18 + rows.get(`${job.task}@${job.node}`) * ROW;
    // A copy that waits when the other one has completed its cycle is cancelled.
    const cancelled = !job.shadow && job.outcome === "in_flight" && job.start_ms === null ? done.get(job.cycle) ?? null : null;
    const from = job.start_ms ?? job.end_ms ?? cancelled ?? last;
    const outcome = cancelled === null ? job.outcome : "cancelled";
    const words = `${job.task} on ${job.node}, cycle ${job.cycle}: ready ${number(job.ready_ms, 2)}, from ${number(job.start_ms, 2)} to ${number(job.end_ms, 2)} ms, ${outcome}${job.shadow ? ", shadow" : ""}${job.second ? ", second copy" : ""}`;
    if (from - job.ready_ms > 0.01)
      svg.append(draw("line", { class: "wait", x1: clipped(x(job.ready_ms)), y1: y + 8, x2: clipped(x(from)), y2: y + 8 }));
    if (job.start_ms === null || x(from) >= width - RIGHT) continue;
    const kind = [job.cycle % 2 ? "odd" : "", job.shadow ? "shadow" : "", job.second ? "second" : "", job.outcome === "done" ? "" : "lost"];
    const [at, until] = [clipped(x(from)), clipped(x(job.end_ms ?? last))];
    const box = { x: at, y: y + 2, width: Math.max(until - at, 1), height: ROW - 6, rx: 2 };
    svg.append(draw("rect", { class: `job ${kind.join(" ")}`, ...box }, draw("title", { text: words })));
  }
  plot.replaceChildren(svg);
  say(root.querySelector(".said"), "by cycle; dashed: deadlines");
};
