// The page: one time line, its cells, and the controls to move along it.

import { charts, difference, extremes } from "./charts.js";
import { count, make, place, say } from "./dom.js";
import { FleetView } from "./fleet.js";
import { gantt } from "./gantt.js";
import * as panel from "./panel.js";
import { RunsView } from "./runs.js";
import { act, get, latest } from "./server.js";
import { Topology } from "./topology.js";

/** Seconds that a live page shows, and largest number of cycles whose jobs are shown. */
const FOLLOWED_S = 60;
const FEW_CYCLES = 40;
const BINS = 700;
/** Time without events after which a live page shows the cell as absent. */
const STALE_MS = 3000;

const element = (id) => document.getElementById(id);

class CellView {
  constructor(cell, i, page) {
    Object.assign(this, { cell, i, page });
    this.root = element("cell").content.firstElementChild.cloneNode(true);
    this.root.querySelector(".name").textContent = cell.name;
    this.root.querySelector(".source").textContent = cell.source;
    element("cells").append(this.root);
    this.describe(cell);
    this.topology = new Topology(this.root.querySelector(".topology"), cell);
    this.charts = charts(this.root, page, cell);
    this.decided = panel.decided(this.root, cell, page);
    this.load = latest(() => this.loadView(), (error) => page.failed(error));
    this.loadState = latest(() => this.stateAt(), (error) => page.failed(error));
    this.state = null;
  }

  describe(cell) {
    this.cell = cell;
    panel.describe(this.root, cell);
  }

  /** The shortest view: two cycles. */
  get least() {
    return 2 * (this.page.unit === "cycle" ? 1 : this.cell.period_ms / 1000);
  }

  async loadView() {
    const [begin, end] = this.page.view;
    const bins = Math.min(BINS, Math.max(150, Math.round(this.root.clientWidth)));
    const view = await get("/view", { cell: this.i, begin, end, bins });
    this.page.extremes.set(this.i, extremes(view));
    this.charts.set(view);
    for (const other of this.page.cells) if (other !== this) other.charts.rescale();
    panel.events(this.root, this.cell, view, this.page);
    const part = this.root.querySelector(".gantt");
    const few = view.released > 0 && view.released <= FEW_CYCLES && this.cell.has_jobs;
    part.hidden = !few;
    if (few) gantt(part, this.cell, this.page, await get("/jobs", { cell: this.i, begin, end }));
  }

  async stateAt() {
    this.show(await get("/state", { cell: this.i, at: this.page.at }));
  }

  show(state) {
    this.state = state;
    this.topology.show(state);
    this.decided(state);
    panel.health(this.root, state, this.page.stale);
    panel.facts(this.root, this.cell, state);
    panel.stages(this.root, state);
    panel.heard(this.root, state);
    this.charts.read(state);
  }

  redraw() {
    this.charts.redraw();
  }
}

class Page {
  /** Show cells or a fleet; `numbered` is the number of a cell in its fleet, or of a run in its folder. */
  constructor({ cells: alone, fleet, runs, line, control, read_only, difference: differs }, numbered, at) {
    const cells = alone.length ? alone : [fleet];
    this.described = cells;
    this.extremes = new Map();
    this.control = control;
    this.readOnly = read_only;
    this.unit = cells[0].unit;
    this.live = cells.some((cell) => cell.live);
    this.span = [Math.min(...cells.map((cell) => cell.begin)), Math.max(...cells.map((cell) => cell.end))];
    this.view = this.live ? [this.span[1] - FOLLOWED_S, this.span[1]] : [...this.span];
    this.at = this.live ? this.span[1] : (at ?? cells[0].worst?.at ?? this.span[1]);
    this.playing = false;
    this.following = this.live;
    this.heardMs = performance.now();
    this.ticks = (_, splits) => splits.map((at) => (this.unit === "cycle" ? count(at) : String(+at.toFixed(3))));
    document.title = `${cells.map((cell) => cell.name).join(" and ")} – Dwell`;
    element("about").textContent = [this.live ? "live" : "replay", line, this.live && !control ? "read-only" : ""].filter(Boolean).join(" · ");
    element("cells").classList.toggle("two", cells.length > 1);
    this.cells = alone.length ? cells.map((cell, i) => new CellView(cell, numbered ?? i, this)) : [new FleetView(fleet, this)];
    element("cycles").hidden = !alone.length;
    if (fleet) this.leadBack(`${fleet.name}, the fleet`);
    if (runs) this.leadBack(`all runs in ${runs.name}`);
    if (differs) this.compare(cells);
    this.windowLength = (cell) => (this.unit === "cycle" ? cell.window_cycles : (cell.window_cycles * cell.period_ms) / 1000);
    this.listen();
    this.setView(...this.view);
    this.moveTo(this.at);
    this.readEvents();
  }

  /** Scales that all cells of the page share. */
  most(name, least) {
    return Math.max(...[...this.extremes.values()].map((one) => one[name]), least);
  }

  top() {
    const due = Math.max(...this.described.map(({ deadline_ms }) => deadline_ms));
    return Math.min(this.most("latency", due * 1.18) * 1.06, due * 3);
  }

  costs() {
    const known = [...this.extremes.values()].flatMap(({ costs }) => costs ?? []);
    return known.length ? uPlot.rangeNum(Math.min(...known), Math.max(...known), 0.1, false) : [0, 1];
  }

  /** Show the difference of missed deadlines between two runs. */
  compare([first, second]) {
    const root = element("difference");
    root.hidden = false;
    const chart = difference(root, this, first);
    const words = `${second.source} less ${first.source}, points of per cent; above 0 the second misses more`;
    this.difference = {
      load: latest(
        async () => {
          const [begin, end] = this.view;
          chart.set(await get("/difference", { begin, end, bins: Math.round(root.clientWidth / 6) }), words);
        },
        (error) => this.failed(error),
      ),
      redraw: chart.redraw,
    };
  }

  /** Link a cell's page to the page of its fleet, or a run's page to the list of runs. */
  leadBack(name) {
    if (this.cells[0] instanceof FleetView) return;
    const link = make("a", { href: "/", text: `◀ ${name}` });
    this.lead(link);
    element("back-to-fleet").replaceChildren(link);
  }

  /** Let a link keep the place on the time line, forwards and with the browser's back button. */
  lead(link) {
    link.addEventListener("click", () => {
      link.hash = String(this.at);
      history.replaceState(null, "", `#${this.at}`);
    });
  }

  get stale() {
    return this.live && performance.now() - this.heardMs > STALE_MS;
  }

  // ------------------------------------------------------------------ along the time line

  setView(begin, end) {
    const [first, last] = this.span;
    const { least } = this.cells[0];
    const length = Math.min(Math.max(end - begin, least), Math.max(last - first, least));
    const low = this.following ? end - length : Math.min(Math.max(begin, first), last - length);
    this.view = [low, low + length];
    for (const cell of this.cells) cell.load();
    this.difference?.load();
    this.showPlace();
  }

  zoom(begin, end) {
    this.follow(false);
    this.setView(begin, end);
    if (this.at < begin || this.at >= end) this.moveTo(begin);
  }

  zoomBy(factor) {
    const [begin, end] = this.view;
    const inside = this.at >= begin && this.at <= end;
    const centre = this.following ? end : inside ? this.at : (begin + end) / 2;
    if (this.following) this.setView(end - (end - begin) * factor, end);
    else this.setView(centre - (centre - begin) * factor, centre + (end - centre) * factor);
  }

  moveTo(at) {
    if (this.live) return;
    this.at = Math.min(Math.max(at, this.span[0]), this.span[1]);
    const [begin, end] = this.view;
    const length = end - begin;
    if (this.at < begin) this.setView(this.at - 0.1 * length, this.at + 0.9 * length);
    else if (this.at > end) this.setView(this.at - 0.1 * length, this.at + 0.9 * length);
    for (const cell of this.cells) {
      cell.loadState();
      cell.redraw();
    }
    this.difference?.redraw();
    this.showPlace();
  }

  step(windows) {
    this.play(false);
    const length = this.windowLength(this.cells[0].cell);
    if (this.live) {
      this.follow(false);
      this.setView(this.view[0] + windows * length, this.view[1] + windows * length);
    } else this.moveTo(this.at + windows * length);
  }

  /** Show the window that ends at a place, with one window before it and one after. */
  toWindow(at) {
    const length = this.windowLength(this.cells[0].cell);
    this.follow(false);
    this.setView(at - 2 * length, at + length);
    this.moveTo(at);
  }

  /** Show the worst window of the first run. */
  toWorst() {
    const at = this.described[0].worst?.at;
    if (!this.live && at !== undefined) this.toWindow(at);
  }

  toCycles() {
    if (element("cycles").hidden) return;
    const each = this.unit === "cycle" ? 1 : this.cells[0].cell.period_ms / 1000;
    const at = this.live ? this.view[1] - 12 * each : this.at;
    this.follow(false);
    this.setView(at - 2 * each, at + 10 * each);
  }

  play(on) {
    this.playing = on && !this.live;
    element("play").textContent = this.playing ? "Pause" : "Play";
    if (!this.playing) return;
    if (this.at >= this.span[1]) this.moveTo(this.span[0]);
    let before = performance.now();
    const frame = (now) => {
      if (!this.playing) return;
      const seconds = ((now - before) / 1000) * Number(element("speed").value);
      before = now;
      const each = this.unit === "cycle" ? 1000 / this.cells[0].cell.period_ms : 1;
      this.moveTo(this.at + seconds * each);
      if (this.at >= this.span[1]) this.play(false);
      else setTimeout(() => requestAnimationFrame(frame), 60);
    };
    requestAnimationFrame(frame);
  }

  follow(on) {
    this.following = on && this.live;
    element("follow").setAttribute("aria-pressed", String(this.following));
  }

  showPlace() {
    const [first, last] = this.span;
    const at = this.live ? this.view[1] : this.at;
    const slider = element("at");
    slider.value = String((1000 * (at - first)) / Math.max(last - first, 1e-9));
    slider.setAttribute("aria-valuetext", place(at, this.unit));
    element("place").textContent = `${place(at, this.unit)} of ${place(last, this.unit)}`;
  }

  listen() {
    const on = (id, what) => element(id).addEventListener("click", what);
    element("timeline").hidden = false;
    element("follow").hidden = !this.live;
    element("play").hidden = this.live;
    element("speed").parentElement.hidden = this.live;
    on("play", () => this.play(!this.playing));
    on("back", () => this.step(-1));
    on("forth", () => this.step(1));
    on("closer", () => this.zoomBy(0.5));
    on("farther", () => this.zoomBy(2));
    on("window", () => this.toWindow(this.live ? this.view[1] : this.at));
    on("cycles", () => this.toCycles());
    on("worst", () => this.toWorst());
    element("worst").hidden = this.live || !this.described[0].worst;
    on("whole", () => this.zoom(...this.span));
    on("follow", () => {
      this.follow(!this.following);
      if (this.following) this.setView(this.span[1] - FOLLOWED_S, this.span[1]);
    });
    element("at").addEventListener("input", (event) => {
      const at = this.span[0] + (event.target.value / 1000) * (this.span[1] - this.span[0]);
      if (!this.live) return this.moveTo(at);
      this.follow(false);
      this.setView(at - (this.view[1] - this.view[0]), at);
    });
    const keys = {
      " ": () => this.play(!this.playing),
      ArrowLeft: () => this.step(-1),
      ArrowRight: () => this.step(1),
      Home: () => this.moveTo(this.span[0]),
      End: () => this.moveTo(this.span[1]),
      "+": () => this.zoomBy(0.5),
      "-": () => this.zoomBy(2),
      0: () => this.zoom(...this.span),
      w: () => this.toWindow(this.live ? this.view[1] : this.at),
      c: () => this.toCycles(),
      x: () => this.toWorst(),
    };
    document.addEventListener("keydown", (event) => {
      const busy = event.target.closest("button, input, select, a");
      if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
      if (busy && [" ", "ArrowLeft", "ArrowRight", "Home", "End"].includes(event.key)) return;
      event.preventDefault();
      keys[event.key]();
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
      for (const cell of this.cells) cell.redraw();
      this.difference?.redraw();
    });
  }

  // ------------------------------------------------------------------------ events

  readEvents() {
    const source = new EventSource("/events");
    source.addEventListener("open", () => this.heard());
    source.addEventListener("error", () => this.failed(new Error("the page's process is silent")));
    source.addEventListener("message", ({ data }) => {
      this.heard();
      for (const news of JSON.parse(data)) this.take(this.cells[news.cell], news);
    });
    if (!this.live) return;
    setInterval(() => {
      if (this.stale) for (const cell of this.cells) if (cell.state) panel.health(cell.root, cell.state, true);
    }, 1000);
  }

  take(cell, news) {
    const { state, described } = news;
    if (described) {
      cell.describe(described);
      this.described[news.cell] = described;
      const atEnd = this.view[1] >= this.span[1];
      this.span[1] = Math.max(this.span[1], described.end);
      if (atEnd) this.setView(this.view[0], this.span[1]);
      else cell.load();
      this.showPlace();
    }
    if (!state) return;
    cell.show(state);
    this.span[1] = Math.max(this.span[1], state.at);
    if (this.following) this.setView(state.at - (this.view[1] - this.view[0]), state.at);
  }

  heard() {
    this.heardMs = performance.now();
    element("connection").classList.remove("bad");
    say(element("connection"), "");
  }

  failed(error) {
    element("connection").classList.add("bad");
    say(element("connection"), `✕ ${error.message}`);
  }

  // ---------------------------------------------------------------------------- commands

  async act(what, about, words) {
    if (!confirm(`${words}?`)) return;
    try {
      await act(what, about);
    } catch (error) {
      this.failed(error);
    }
  }

  pin(candidate) {
    return this.act("pin", { candidate }, `Pin the cell to ${candidate}`);
  }

  unpin() {
    return this.act("unpin", {}, "Let the policy decide again");
  }

  drain(node) {
    const drained = (this.cells[0].state?.drained ?? []).includes(node);
    return this.act(drained ? "undrain" : "drain", { node }, drained ? `Let stages run on ${node} again` : `Keep all stages off ${node}`);
  }
}

// Hours of playing make a million requests; the browser need not store their times.
performance.setResourceTimingBufferSize(0);
/** Place of the previous page on the time line, and the number of the cell in the fleet. */
const before = location.hash.length > 1 ? Number(location.hash.slice(1)) : NaN;
const [, numbered] = location.pathname.match(/^\/cell\/(\d+)$/) ?? [];
// The cookie has the token: remove it from the address and the history.
history.replaceState(null, "", location.pathname);
try {
  const found = await get("/cells", numbered === undefined ? {} : { cell: numbered });
  if (found.runs && !found.cells.length) window.page = new RunsView(found.runs);
  else window.page = new Page(found, numbered, Number.isFinite(before) ? before : null);
} catch (error) {
  element("connection").classList.add("bad");
  say(element("connection"), `✕ ${error.message}`);
}
