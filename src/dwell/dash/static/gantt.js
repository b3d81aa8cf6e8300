// The jobs of a few cycles, each on its node.

import { draw, number, say } from "./dom.js";

const ROW = 18;
const LEFT = 110;

export const gantt = (root, cell, { jobs, cycles }) => {
  const plot = root.querySelector(".plot");
  const rows = new Map();
  for (const { name: node } of cell.nodes)
    for (const { name: task, on } of cell.tasks)
      if (on.includes(node)) rows.set(`${task}@${node}`, rows.size);
  const width = Math.max(plot.clientWidth, 280);
  const left = Math.min(LEFT, width * 0.3);
  const ends = jobs.flatMap((job) => [job.ready_ms, job.start_ms, job.end_ms].filter((at) => at !== null));
  const last = Math.max(...ends, ...cycles.map(({ release_ms }) => release_ms + cell.deadline_ms), 1);
  const x = (ms) => left + (ms / last) * (width - left - 8);
  const height = rows.size * ROW + 24;
  const svg = draw("svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img" });
  const missed = cycles.filter((cycle) => cycle.missed).map(({ cycle }) => cycle);
  svg.append(draw("title", { text: `${jobs.length} jobs of ${cycles.length} cycles; missed: ${missed.join(", ") || "none"}` }));
  for (const cycle of cycles) {
    const at = x(cycle.release_ms);
    const due = x(cycle.release_ms + cell.deadline_ms);
    svg.append(
      draw("line", { class: "release", x1: at, y1: 14, x2: at, y2: height - 8 }),
      draw("line", { class: "due", x1: due, y1: 14, x2: due, y2: height - 8 }),
    );
    if (x(cell.period_ms) - x(0) > 34)
      svg.append(draw("text", { x: at + 3, y: 11, text: `${cycle.cycle}${cycle.missed ? " ×" : ""}` }));
  }
  for (const [name, row] of rows)
    svg.append(draw("text", { class: "muted", x: left - 6, y: 18 + row * ROW + 12, "text-anchor": "end", text: name }));
  for (const job of jobs) {
    const y = 18 + rows.get(`${job.task}@${job.node}`) * ROW;
    const begin = job.start_ms ?? job.end_ms ?? last;
    const words = `${job.task} on ${job.node}, cycle ${job.cycle}: ready ${number(job.ready_ms, 2)}, from ${number(job.start_ms, 2)} to ${number(job.end_ms, 2)} ms, ${job.outcome}${job.shadow ? ", shadow" : ""}`;
    if (begin - job.ready_ms > 0.01)
      svg.append(draw("line", { class: "wait", x1: x(job.ready_ms), y1: y + 8, x2: x(begin), y2: y + 8 }));
    if (job.start_ms === null) continue;
    const kind = [job.cycle % 2 ? "odd" : "", job.shadow ? "shadow" : "", job.outcome === "done" ? "" : "lost"];
    const box = { x: x(begin), y: y + 2, width: Math.max(x(job.end_ms ?? last) - x(begin), 1), height: ROW - 6, rx: 2 };
    svg.append(draw("rect", { class: `job ${kind.join(" ")}`, ...box }, draw("title", { text: words })));
  }
  plot.replaceChildren(svg);
  say(root.querySelector(".said"), `${number(last, 0)} ms from the first release; dashed: deadlines`);
};
