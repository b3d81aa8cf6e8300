// Computers by tier with the stages that run there; a stage slides when it moves.

import { fitted } from "./charts.js";
import { draw, percent } from "./dom.js";

const TIERS = ["cloud", "edge", "robot"];
const SLOT = 26;
const HEAD = 24;
const FOOT = 18;
const GAP = 14;
const LEAST_NODE = 150;
const BETWEEN = 52;
/** Largest number of node pairs whose links have a label while undisturbed. */
const LABELLED = 12;

/** Rows of nodes, from the cloud at the top to the robots; each row has as many nodes as fit. */
const rowsOf = (nodes, width) => {
  const most = Math.max(1, Math.floor((width + GAP) / (LEAST_NODE + GAP)));
  return TIERS.flatMap((tier) => {
    const mine = nodes.filter((node) => node.tier === tier);
    const rows = [];
    for (let i = 0; i < mine.length; i += most) rows.push(mine.slice(i, i + most));
    return rows;
  });
};

export class Topology {
  constructor(root, cell) {
    this.root = root;
    this.cell = cell;
    this.state = null;
    this.width = 0;
    new ResizeObserver(() => this.resize()).observe(root);
    this.resize();
  }

  resize() {
    const width = Math.max(280, Math.round(this.root.clientWidth));
    if (width === this.width) return;
    this.width = width;
    this.build();
    if (this.state !== null) this.show(this.state);
  }

  build() {
    const { nodes, tasks, links } = this.cell;
    const wide = Math.min(this.width, 620);
    this.narrow = wide < 480;
    const mayRun = (node) => tasks.filter((task) => task.on.includes(node.name));
    this.boxes = new Map();
    this.slots = new Map();
    let y = 2;
    for (const row of rowsOf(nodes, wide)) {
      const width = Math.min(230, (wide - GAP * (row.length + 1)) / row.length);
      const height = HEAD + FOOT + SLOT * Math.max(1, ...row.map((node) => mayRun(node).length));
      // A single cloud is on the right: its links to robots then do not cross the edge.
      const left = row.length === 1 && row[0].tier === "cloud" ? wide - width - GAP / 2 : (wide - row.length * width - (row.length - 1) * GAP) / 2;
      row.forEach((node, i) => {
        const x = row.length === 2 ? (i === 0 ? GAP / 2 : wide - width - GAP / 2) : left + i * (width + GAP);
        this.boxes.set(node.name, { x, y, width, height });
        mayRun(node).forEach((task, slot) =>
          this.slots.set(`${task.name}@${node.name}`, [x + 8, y + HEAD + slot * SLOT, width - 16]),
        );
      });
      y += height + BETWEEN;
    }
    const svg = draw("svg", { viewBox: `0 0 ${wide} ${y - BETWEEN + 4}`, role: "img" });
    this.title = draw("title");
    svg.append(this.title, ...this.links(links));
    this.nodes = new Map(nodes.map((node) => [node.name, this.node(node)]));
    svg.append(...[...this.nodes.values()].map((parts) => parts.group));
    this.possible = new Map();
    for (const [i, task] of tasks.entries())
      for (const node of task.on) {
        const [x, top, width] = this.slots.get(`${task.name}@${node}`);
        const name = draw("text", { class: "possible", x: x + 8, y: top + 14.5, text: fitted(`${i + 1} ${task.name}`, width - 14) });
        this.possible.set(`${task.name}@${node}`, name);
        svg.append(draw("rect", { class: "slot", x, y: top, width, height: SLOT - 6, rx: 4 }), name);
      }
    this.stages = new Map(tasks.map((task, i) => [task.name, this.stage(task, i)]));
    this.seconds = new Map(tasks.map((task, i) => [task.name, this.stage(task, i)]));
    for (const [name, group] of this.seconds) {
      group.classList.add("second");
      group.removeAttribute("data-task");
      group.dataset.second = name;
    }
    svg.append(...this.stages.values(), ...this.seconds.values());
    svg.style.maxWidth = `${wide}px`;
    this.root.replaceChildren(svg);
  }

  links(links) {
    const seen = new Set();
    this.pairs = new Map();
    this.crowded = links.length > 2 * LABELLED;
    return links.flatMap(({ source, target, text }) => {
      const key = [source, target].sort().join("\n");
      if (seen.has(key)) return [];
      seen.add(key);
      const [a, b] = [this.boxes.get(source), this.boxes.get(target)];
      const [x1, y1] = [a.x + a.width / 2, a.y + a.height / 2];
      const [x2, y2] = [b.x + b.width / 2, b.y + b.height / 2];
      const line = draw("line", { x1, y1, x2, y2 });
      const words = this.crowded ? "" : this.narrow ? text.split(",")[0] : text;
      // A label fits between two rows, but often not between neighbours in a row.
      const [upper, lower] = a.y < b.y ? [a, b] : [b, a];
      let [x, y, room] = [0, y1 + 4, true];
      if (upper.y === lower.y) {
        const [left, right] = a.x < b.x ? [a, b] : [b, a];
        x = (left.x + left.width + right.x) / 2;
        room = right.x - left.x - left.width >= 120;
      } else {
        y = (upper.y + upper.height + lower.y) / 2;
        x = x1 + ((y + 4 - y1) / (y2 - y1)) * (x2 - x1);
      }
      const nominal = draw("text", { x, y: y + 4, text: words });
      const now = draw("text", { class: "now", x, y: y + 19 });
      const group = draw("g", { class: "link" }, line, ...(room ? [nominal, now] : []));
      this.pairs.set(key, { group, now, nominal, y });
      return [group];
    });
  }

  node(node) {
    const { x, y, width, height } = this.boxes.get(node.name);
    const bar = { x: x + 8, y: y + height - 13, height: 6, rx: 3 };
    const busy = draw("rect", { class: "busy", ...bar, width: 0 });
    const share = draw("text", { class: "percent", x: x + width - 8, y: y + height - 6 });
    const tier = draw("tspan", { class: "tier", text: ` ${node.tier}, ${node.cores} ${node.cores === 1 ? "core" : "cores"}` });
    const name = draw("text", { x: x + 9, y: y + 16 }, draw("tspan", { text: node.name, "font-weight": 650 }), tier);
    const group = draw(
      "g",
      { class: "node" },
      draw("rect", { class: "box", x, y, width, height, rx: 6 }),
      name,
      draw("rect", { class: "bar", ...bar, width: width - 56 }),
      busy,
      share,
    );
    return { group, busy, share, room: width - 56, tier, words: tier.textContent };
  }

  stage(task, i) {
    const [x, y, width] = this.slots.get(`${task.name}@${task.on[0]}`);
    const anchored = task.on.length === 1;
    const shape = draw("rect", { width, height: SLOT - 6, rx: 4 });
    const text = draw("text", { x: 8, y: 14.5, text: fitted(`${i + 1} ${task.name}`, width - 14) });
    const group = draw("g", { class: anchored ? "stage anchored" : "stage", "data-task": task.name }, shape, text);
    group.style.transform = `translate(${x}px, ${y}px)`;
    return group;
  }

  /** Move the box of a stage to a computer; without a computer, hide it. */
  place(group, task, node, hue) {
    group.style.visibility = node === undefined ? "hidden" : "visible";
    if (node === undefined) return;
    const [x, y, width] = this.slots.get(`${task.name}@${node}`);
    group.style.transform = `translate(${x}px, ${y}px)`;
    group.style.setProperty("--hue", hue);
    group.dataset.node = node;
    group.firstChild.setAttribute("width", width);
  }

  /** Move each stage to its computers, and show the load of each computer. */
  show(state) {
    this.state = state;
    const candidate = this.cell.candidates.find(({ name }) => name === state.placement);
    const words = [];
    for (const task of this.cell.tasks) {
      const on = candidate?.nodes[task.name] ?? [task.on[0]];
      const hue = candidate?.hue ?? "gray";
      this.place(this.stages.get(task.name), task, on[0], hue);
      this.place(this.seconds.get(task.name), task, on[1], hue);
      for (const other of task.on) this.possible.get(`${task.name}@${other}`).classList.toggle("taken", on.includes(other));
      words.push(`${task.name} on ${on.join(" and ")}`);
    }
    const drained = new Set(state.drained ?? []);
    for (const [name, parts] of this.nodes) {
      const share = state.used?.[name];
      parts.busy.setAttribute("width", parts.room * Math.min(Math.max(share ?? 0, 0), 1));
      parts.share.textContent = percent(share);
      parts.group.classList.toggle("drained", drained.has(name));
      const met = state.disturbed?.[name];
      parts.group.classList.toggle("disturbed", Boolean(met));
      parts.tier.textContent = drained.has(name) ? " drained" : met ? ` ${met}` : parts.words;
      if (met) words.push(`${name}: ${met}`);
    }
    for (const [key, { group, now, nominal, y }] of this.pairs) {
      const [one, other] = key.split("\n");
      const met = new Set([state.disturbed?.[`${one}->${other}`], state.disturbed?.[`${other}->${one}`]].filter(Boolean));
      const text = [...met].join("; ");
      group.classList.toggle("disturbed", met.size > 0);
      now.textContent = this.narrow && text.includes(",") ? `${text.split(",")[0]} …` : text;
      nominal.setAttribute("y", text ? y - 3 : y + 4);
      now.setAttribute("y", y + 12);
      if (text) words.push(`${one}–${other}: ${text}`);
    }
    this.title.textContent = `${state.placement ?? "unknown"}: ${words.join(", ")}`;
  }
}
