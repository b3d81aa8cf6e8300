// The runs of a folder: a table with columns to sort by, and several runs in one plot.

import { DASHES } from "./charts.js";
import { colour, count, draw, make, number, percent, say } from "./dom.js";
import { get, latest } from "./server.js";

/** Rows shown at first and added per click, and largest number of runs in one plot. */
const ROWS = 200;
const MOST_DRAWN = 8;
const EVERY_MS = 1000;
const MARKS = { kept: "● kept", missed: "▲ missed", open: "○ open" };
const STATES = { running: "… running", unfinished: "◌ not closed", broken: "✕ broken", fleet: "a fleet" };

/** Columns: key, heading, text of a row, whether it is a number. */
const COLUMNS = [
  ["run", "run", ({ run }) => run, false],
  ["verdict", "verdict", ({ verdict, state }) => MARKS[verdict] ?? STATES[state] ?? "", false],
  ["rate", "V_D", ({ rate }) => percent(rate, 2), true],
  ["cost", "J", ({ cost }) => number(cost, 3), true],
  ["moves", "moves", ({ moves }) => (moves === null || moves === undefined ? "–" : count(moves)), true],
  ["windows", "windows", ({ windows }) => (windows === undefined ? "–" : count(windows)), true],
  ["cell", "cell", ({ cell }) => cell ?? "", false],
  ["scenario", "scenario", ({ scenario }) => scenario ?? "", false],
  ["policy", "policy", ({ policy }) => policy ?? "", false],
  ["seed", "seed", ({ seed }) => (seed === null || seed === undefined ? "" : String(seed)), true],
];
const known = (value) => value !== undefined && value !== null && value !== "";

export class RunsView {
  constructor({ name, runs, more }) {
    this.root = document.getElementById("runs").content.firstElementChild.cloneNode(true);
    document.getElementById("cells").append(this.root);
    document.title = `${name} – Dwell`;
    this.part = (one) => this.root.querySelector(one);
    this.part(".name").textContent = name;
    const beyond = more ? `; ${count(more)} further runs are not listed` : "";
    this.part(".caption").textContent = `Select up to ${MOST_DRAWN} runs to draw them in one plot. A click on a heading sorts; a click on a name opens the run${beyond}.`;
    this.rows = runs.map((run, place) => ({ place, run, state: "unread", note: "" }));
    this.selected = new Set();
    this.shown = ROWS;
    this.by = "run";
    this.up = true;
    this.upto = 0;
    this.readRows = 0;
    this.header();
    this.part("#filter").addEventListener("input", () => this.draw());
    this.part(".further").addEventListener("click", () => {
      this.shown += ROWS;
      this.draw();
    });
    this.plotLines = latest(() => this.drawLines(), (error) => this.failed(error));
    this.load = latest(() => this.loadRows(), (error) => this.failed(error));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.plot?.redraw());
    this.draw();
    this.load();
    setInterval(() => this.load(), EVERY_MS);
  }

  header() {
    const row = this.part("thead tr");
    row.append(make("th", { scope: "col" }, make("span", { class: "hidden", text: "in the plot" })));
    for (const [key, text, , numeric] of COLUMNS) {
      const button = make("button", { type: "button", text, onclick: () => this.sort(key) });
      row.append(make("th", { scope: "col", class: numeric ? "num" : null, "data-key": key }, button));
    }
    row.append(make("th", { scope: "col", text: "note" }));
  }

  sort(key) {
    this.up = this.by === key ? !this.up : true;
    this.by = key;
    this.draw();
  }

  async loadRows() {
    const { rows, upto } = await get("/runs", { since: this.upto });
    say(document.getElementById("connection"), "");
    if (!rows.length) return;
    this.upto = upto;
    for (const row of rows) this.rows[row.place] = { ...this.rows[row.place], ...row };
    this.draw();
  }

  failed(error) {
    say(document.getElementById("connection"), `✕ ${error.message}`);
  }

  /** Rows in the order of the chosen column; rows without a value are last. */
  sorted() {
    const text = this.part("#filter").value.trim().toLowerCase();
    const words = ({ run, cell, policy, scenario, state, verdict }) => [run, cell, policy, scenario, state, verdict].filter(known).join(" ").toLowerCase();
    const rows = this.rows.filter((row) => !text || words(row).includes(text));
    const value = this.by === "verdict" ? (row) => row.verdict ?? (row.state === "unread" ? null : row.state) : (row) => row[this.by];
    const sign = this.up ? 1 : -1;
    return rows.sort((one, other) => {
      const [a, b] = [value(one), value(other)];
      if (!known(a) || !known(b)) return known(b) - known(a) || one.place - other.place;
      const order = typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true });
      return sign * order || one.place - other.place;
    });
  }

  draw() {
    const done = this.rows.filter(({ state }) => state !== "unread");
    const tally = (test) => done.filter(test).length;
    const parts = [`${count(this.rows.length)} ${this.rows.length === 1 ? "run" : "runs"}`];
    if (done.length < this.rows.length) parts.push(`${count(done.length)} read`);
    for (const word of ["kept", "missed", "open"]) if (tally(({ verdict }) => verdict === word)) parts.push(`${count(tally(({ verdict }) => verdict === word))} ${word}`);
    for (const [state, word] of [["running", "running"], ["unfinished", "not closed"], ["broken", "broken"]])
      if (tally((row) => row.state === state)) parts.push(`${count(tally((row) => row.state === state))} ${word}`);
    say(this.part(".source"), parts.join(", "));
    for (const head of this.root.querySelectorAll("th[data-key]"))
      head.setAttribute("aria-sort", head.dataset.key === this.by ? (this.up ? "ascending" : "descending") : "none");
    const rows = this.sorted();
    const focused = document.activeElement?.closest?.("tr[data-place]")?.dataset.place;
    const what = document.activeElement?.tagName;
    this.part("tbody").replaceChildren(...rows.slice(0, this.shown).map((row) => this.row(row)));
    if (focused !== undefined) this.part(`tr[data-place="${focused}"] ${what === "A" ? "a" : "input"}`)?.focus();
    const further = this.part(".further");
    further.hidden = rows.length <= this.shown;
    further.textContent = `Show ${count(Math.min(ROWS, rows.length - this.shown))} more of ${count(rows.length)}`;
  }

  row(row) {
    const drawable = ["done", "unfinished", "running"].includes(row.state);
    const box = make("input", { type: "checkbox", "aria-label": `${row.run} in the plot`, disabled: !drawable });
    box.checked = this.selected.has(row.place);
    box.addEventListener("change", () => this.select(row.place, box.checked));
    const bad = row.verdict === "missed" || row.state === "broken";
    const cells = COLUMNS.map(([key, , text, numeric]) => {
      if (key === "run") return make("th", { scope: "row" }, drawable ? make("a", { href: `/cell/${row.place}`, text: row.run }) : row.run);
      const tone = key !== "verdict" ? null : bad ? "bad" : row.verdict === "kept" ? "ok" : null;
      return make("td", { class: [numeric ? "num" : "", tone ?? ""].join(" ").trim() || null, text: text(row) });
    });
    return make("tr", { "data-place": row.place }, make("td", {}, box), ...cells, make("td", { class: "note", text: row.note }));
  }

  select(place, on) {
    if (on && this.selected.size >= MOST_DRAWN) this.selected.delete([...this.selected][0]);
    if (on) this.selected.add(place);
    else this.selected.delete(place);
    for (const row of this.root.querySelectorAll("tr[data-place]")) row.querySelector("input").checked = this.selected.has(Number(row.dataset.place));
    this.plotLines();
  }

  /** Draw V_D of the selected runs; time counts from each run's first release. */
  async drawLines() {
    const part = this.part(".plotted");
    part.hidden = this.selected.size === 0;
    this.plot?.destroy();
    this.plot = null;
    if (part.hidden) return;
    const runs = await get("/lines", { cells: [...this.selected].join(",") });
    const data = uPlot.join(runs.map(({ at, rates }) => [at, rates]));
    const plot = this.part(".plotted .plot");
    const axis = (more) => ({ stroke: () => colour("--muted"), grid: { stroke: () => colour("--rule"), width: 1 }, ticks: { show: false }, font: "11.5px system-ui, sans-serif", ...more });
    const series = runs.map((_, i) => ({ stroke: () => colour(`--hue-${i}`), dash: DASHES[i % DASHES.length], width: 1.8, spanGaps: true, points: { show: false } }));
    const aim = (u) => {
      const y = u.valToPos(5, "y", true);
      u.ctx.save();
      u.ctx.strokeStyle = colour("--bad");
      u.ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
      u.ctx.beginPath();
      u.ctx.moveTo(u.bbox.left, y);
      u.ctx.lineTo(u.bbox.left + u.bbox.width, y);
      u.ctx.stroke();
      u.ctx.restore();
    };
    this.plot = new uPlot(
      {
        width: Math.max(plot.clientWidth, 200),
        height: 220,
        padding: [8, 24, 0, 0],
        legend: { show: false },
        cursor: { show: false },
        scales: { x: { time: false }, y: { range: (_, __, high) => [0, Math.max(high ?? 0, 10) * 1.04] } },
        series: [{}, ...series],
        axes: [axis({ size: 24, values: (_, splits) => splits.map((at) => `${+at.toFixed(1)} s`) }), axis({ size: 50 })],
        hooks: { draw: [aim] },
      },
      data,
      plot,
    );
    const named = runs.map(({ place }) => this.rows[place]);
    say(this.part(".plotted .said"), "from the first release of each run; dashed: the aim, 5 %");
    this.plot.root.setAttribute("role", "img");
    this.plot.root.setAttribute("aria-label", `Deadlines missed by window: ${named.map(({ run, rate }) => `${run} ${percent(rate, 2)}`).join(", ")}`);
    this.part(".plotted .legend").replaceChildren(
      ...named.map(({ run, rate }, i) => {
        const sample = draw("line", { x1: 0, y1: 5, x2: 26, y2: 5, "stroke-width": 1.8, "stroke-dasharray": DASHES[i % DASHES.length].join(" ") || null });
        sample.style.stroke = `var(--hue-${i})`;
        return make("li", {}, draw("svg", { width: 26, height: 10, "aria-hidden": "true" }, sample), `${run} `, make("b", { text: percent(rate, 2) }));
      }),
    );
  }
}
