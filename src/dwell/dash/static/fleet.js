// The cells of a fleet as small multiples, worst first, and the charts of the fleet.

import { DASHES, lines, throughout } from "./charts.js";
import { count, draw, make, number, percent, say } from "./dom.js";
import * as panel from "./panel.js";
import { get, latest } from "./server.js";

const BINS = 400;
/** Heights of the marks of lost cycles, of the strip with these marks, and of a lane; width of the drawing. */
const MARKS = 7;
const STRIP = 50;
const LANE = 9;
const WIDE = 1000;
/** Largest number of cell names shown per placement. */
const NAMED = 24;

/** One cell: its name (a link to its page), its health, and its strip above the ribbon. */
class Small {
  constructor(cell, fleet, page) {
    this.cell = cell;
    this.lanes = fleet.placements.map(() => draw("path"));
    this.within = draw("path", { class: "within" });
    this.over = draw("path", { class: "over" });
    this.lost = draw("path", { class: "lost" });
    this.due = draw("path", { class: "due" });
    this.disturbed = throughout(fleet) ? [] : fleet.disturbed;
    this.bands = draw("path", { class: "band" });
    this.title = draw("title");
    this.height = STRIP + 4 + LANE * fleet.placements.length;
    const size = { viewBox: `0 0 ${WIDE} ${this.height}`, height: this.height, preserveAspectRatio: "none", role: "img" };
    const svg = draw("svg", size, this.title, this.bands, this.within, this.over, this.lost, this.due, ...this.lanes);
    this.lanes.forEach((lane, i) => lane.style.setProperty("fill", fleet.placements[i].hue));
    this.deadline = make("span", { text: number(cell.deadline_ms, 0), class: "deadline" });
    const names = fleet.placements.map(({ name }) => make("span", { text: name, title: name }));
    this.link = make("a", { href: `/cell/${cell.place}`, text: cell.name });
    page.lead(this.link);
    this.health = make("span", { class: "health" });
    this.seen = make("p", { class: "seen" });
    this.last = make("p", { class: "last" });
    this.root = make(
      "li",
      { class: "small" },
      make("h4", {}, this.link, make("span", { class: cell.verdict === "missed" ? "rate bad" : "rate", text: `V_D ${percent(cell.rate, 2)}${cell.verdict ? `: ${cell.verdict}` : ""}` })),
      make("p", {}, this.health),
      make("div", { class: "plot" }, make("div", { class: "lanes", "aria-hidden": "true" }, this.deadline, ...names), make("div", { class: "drawn" }, svg)),
      this.seen,
      this.last,
    );
  }

  set(view, [begin, end], top, placements) {
    const x = (at) => ((WIDE * (Math.min(Math.max(at, begin), end) - begin)) / (end - begin)).toFixed(1);
    const y = (ms) => STRIP - ((STRIP - MARKS) * Math.min(ms, top)) / top;
    const { at, high, lost } = view.bins;
    const due = y(this.cell.deadline_ms);
    const [within, over, gone] = [[], [], []];
    at.forEach((from, i) => {
      if (lost[i]) gone.push(`M${x(from)} 0V${MARKS - 2}`);
      // L95 is infinite if it falls on a lost cycle.
      const upper = lost[i] ? MARKS : y(high[i]);
      const bar = (top, bottom) => `M${x(from)} ${top.toFixed(1)}H${x(at[i + 1] ?? end)}V${bottom.toFixed(1)}H${x(from)}z`;
      within.push(bar(Math.max(upper, due), STRIP));
      if (upper < due) over.push(bar(upper, due));
    });
    this.bands.setAttribute("d", this.disturbed.filter(([from, to]) => to > begin && from < end).map(([from, to]) => `M${x(from)} 0H${x(to)}V${STRIP}H${x(from)}z`).join(""));
    this.within.setAttribute("d", within.join(""));
    this.over.setAttribute("d", over.join(""));
    this.lost.setAttribute("d", gone.join(""));
    this.due.setAttribute("d", `M0 ${due.toFixed(1)}H${WIDE}`);
    this.deadline.style.setProperty("top", `${due - 7}px`);
    const stretches = this.lanes.map(() => []);
    const { begin: begins, end: ends, placement } = view.ribbon;
    placement.forEach((lane, i) => {
      const upper = STRIP + 4 + lane * LANE;
      stretches[lane].push(`M${x(begins[i])} ${upper + 1}H${x(ends[i])}V${upper + LANE - 1}H${x(begins[i])}z`);
    });
    this.lanes.forEach((lane, i) => lane.setAttribute("d", stretches[i].join("")));
    const used = [...new Set(placement)].map((lane) => placements[lane].name).join(", ");
    this.title.textContent = `${this.cell.name}: L95 of ${view.over} of ${view.windows} windows in view over the deadline of ${number(this.cell.deadline_ms, 1)} ms; placed ${used || "nowhere"}`;
  }

  show(state) {
    panel.health(this.root, state, false);
    // Health covers only the last windows: a run that missed its aim is not green.
    this.health.classList.toggle("ok", this.cell.verdict !== "missed" && state.health === "ok");
    const { window: seen, decision } = state;
    say(this.seen, seen ? `window ${seen.number}: L95 ${number(seen.seen.l95_ms, 1)} ms, V_D ${percent(seen.seen.violation_rate, 2)}` : "");
    say(this.last, decision ? `decided: ${panel.decided_in_words(decision)}` : `${state.placement}; no decision yet`);
  }
}

export class FleetView {
  constructor(fleet, page) {
    Object.assign(this, { cell: fleet, page });
    this.root = document.getElementById("fleet").content.firstElementChild.cloneNode(true);
    document.getElementById("cells").append(this.root);
    this.part = (name) => this.root.querySelector(`.${name}`);
    this.part("name").textContent = fleet.name;
    this.part("source").textContent = `fleet of ${count(fleet.count)}`;
    panel.describe(this.root, { ...fleet, worst: null });
    this.judge(fleet);
    this.smalls = fleet.cells.map((cell) => new Small(cell, fleet, page));
    this.part("smalls").append(...this.smalls.map(({ root }) => root));
    this.charts = this.common();
    this.load = latest(() => this.loadView(), (error) => page.failed(error));
    this.loadState = latest(() => this.stateAt(), (error) => page.failed(error));
  }

  /** Show how many cells kept the aim. */
  judge({ verdicts, aim, cells, mean_rate }) {
    const part = this.part("verdict");
    const judged = Object.values(verdicts).reduce((sum, one) => sum + one, 0);
    part.hidden = judged === 0;
    if (part.hidden) return;
    const { kept = 0, missed = 0, open = 0 } = verdicts;
    part.classList.toggle("ok", kept === judged);
    part.classList.toggle("bad", missed > 0);
    const others = [missed ? `${count(missed)} missed it` : "", open ? `${count(open)} open` : ""].filter(Boolean).join(", ");
    part.querySelector(".judged").textContent = `${missed ? "▲" : kept === judged ? "●" : "○"} ${count(kept)} of ${count(judged)} cells kept the aim of under ${number(100 * aim, 0)} % missed${others ? `: ${others}` : ""}`;
    part.querySelector(".more").textContent = `deadlines missed after the warm-up: worst ${percent(cells[0].rate, 2)} (${cells[0].name}), mean ${percent(mean_rate, 2)}`;
  }

  /** The shortest view: three windows. */
  get least() {
    return (3 * this.cell.window_cycles * this.cell.period_ms) / 1000;
  }

  /** Charts over time of all cells together: placements, load of shared nodes, Φ. */
  common() {
    const { placements, shared, cells, has_phi } = this.cell;
    const dashed = (i) => DASHES[i % DASHES.length];
    const whole = { range: (_, __, high) => [0, Math.max(cells.length, high ?? 1)] };
    const found = [
      [
        "where",
        placements.map(({ name, hue }, i) => ({ key: `on ${name}`, label: name, hue, dash: dashed(i) })),
        { scale: whole, written: (value) => number(value, 0) },
        (state, key) => count(state.cells.filter(({ placement }) => `on ${placement}` === key).length),
      ],
      [
        "used",
        shared.map((name, i) => ({ key: `u ${name}`, label: name, hue: i % 2 ? "--muted" : "--ink", dash: dashed(i) })),
        { scale: { range: (_, __, high) => [0, Math.max(1, high ?? 1)] }, written: (value) => `${Math.round(100 * value)}` },
        (state, key) => percent(state.used[key.slice(2)]),
      ],
      [
        "phi",
        has_phi ? [{ key: "phi", label: "Φ per cell", hue: "--ink", dash: [] }] : [],
        { scale: { range: (_, low, high) => (low === null ? [0, 1] : uPlot.rangeNum(low, high, 0.1, false)) }, written: (value) => number(value, 1) },
        (state) => (state.round === null ? "–" : `${number(state.phi, 3)}, round ${count(state.round)}`),
      ],
    ];
    return found.flatMap(([name, named, how, value]) => {
      const root = this.part(name);
      root.hidden = named.length === 0;
      if (root.hidden) return [];
      const chart = lines(root, this.page, this.cell, 120, named, { ...how, last: true });
      const set = (view) => chart.set(name === "phi" ? { windows: view.rounds } : view);
      return [{ set, show: (state) => chart.read((key) => value(state, key)) }];
    });
  }

  async loadView() {
    const [begin, end] = this.page.view;
    const bins = Math.min(BINS, Math.max(100, Math.round(this.root.clientWidth / 3)));
    const view = await get("/view", { begin, end, bins });
    const highest = Math.max(...view.cells.flatMap(({ bins: { high } }) => high.filter((value) => value !== null)), 0);
    const due = Math.max(...this.cell.cells.map(({ deadline_ms }) => deadline_ms));
    const top = Math.min(Math.max(highest * 1.06, due * 1.25), due * 3);
    this.view = [begin, end];
    this.plots = this.charts.map((chart) => chart.set(view));
    this.smalls.forEach((small, i) => small.set(view.cells[i], this.view, top, this.cell.placements));
    say(this.part("scale"), `V_D after the warm-up · strips: L95 by window, 0 to ${number(top, 0)} ms; dashed: the deadline; a tick on top: a lost cycle${this.cell.disturbed.length && !throughout(this.cell) ? "; shaded: disturbed" : ""} · lanes: placement`);
    panel.events(this.root, this.cell, view, this.page);
    this.redraw();
  }

  async stateAt() {
    const state = await get("/state", { at: this.page.at });
    panel.health(this.root, state, false);
    state.cells.forEach((cell, i) => this.smalls[i].show(cell));
    for (const chart of this.charts) chart.show(state);
    this.facts(state);
    this.who(state);
  }

  facts({ cells, phi }) {
    const rates = cells.flatMap(({ window: seen }) => seen?.seen.violation_rate ?? []);
    const parts = [];
    if (rates.length) parts.push(`in the last window: worst ${percent(Math.max(...rates), 2)}, mean ${percent(rates.reduce((a, b) => a + b) / rates.length, 2)}`);
    if (phi !== null) parts.push(`Φ per cell ${number(phi, 3)}`);
    say(this.part("facts"), parts.join(" · "));
  }

  /** List the cells by placement. */
  who({ cells }) {
    const body = this.part("who");
    const names = this.cell.placements.map(() => []);
    const place = new Map(this.cell.placements.map(({ name }, i) => [name, i]));
    cells.forEach(({ placement }, i) => names[place.get(placement)].push(this.cell.cells[i].name));
    if (!body.children.length)
      for (const { name, hue } of this.cell.placements)
        body.append(make("tr", {}, make("th", { scope: "row" }, make("span", { class: "swatch", hue, "aria-hidden": "true" }), name), make("td", { class: "num" }), make("td", { class: "note" })));
    [...body.children].forEach((row, i) => {
      const more = names[i].length > NAMED ? `, and ${count(names[i].length - NAMED)} more` : "";
      say(row.children[1], count(names[i].length));
      say(row.children[2], names[i].length ? `${names[i].slice(0, NAMED).join(", ")}${more}` : "none");
    });
  }

  redraw() {
    for (const plot of this.plots ?? []) plot.redraw(false);
    if (!this.view) return;
    const [begin, end] = this.view;
    this.part("smalls").style.setProperty("--at", String((this.page.at - begin) / (end - begin)));
  }
}
