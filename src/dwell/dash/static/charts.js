// Strips along the time line: latency with the deadline and the misses, placement, J, load.

import { colour, count, draw, make, number, percent, say } from "./dom.js";

export const DASHES = [[], [7, 3], [2, 2], [7, 2, 2, 2], [11, 3, 3, 3], [4, 4], [9, 2, 2, 2, 2, 2]];
/** Largest number of bins whose misses are crosses; misses of more bins are lines. */
const CROSSES = 120;
const LANE = 16;
/** Space right of the strips, for half of the last number on their axis. */
export const RIGHT = 24;
const LETTER = 6.4;

/** Space left of the strips and of the jobs, for the longest name of a row. */
export const leftOf = (cells, width) => {
  const names = cells.flatMap(({ candidates, tasks = [], has_jobs }) => [
    ...(candidates ?? []).map(({ name }) => name),
    ...(has_jobs ? tasks.flatMap(({ name, on }) => on.map((node) => `${name}@${node}`)) : []),
  ]);
  const longest = Math.max(...names.map(wide), 6);
  return Math.round(Math.min(Math.max(LETTER * longest + 12, 50), 170, 0.26 * width));
};

/** Width of a text in letters; the letters of Chinese, Japanese and Korean are twice as wide. */
export const wide = (text) => [...text].reduce((sum, letter) => sum + (letter.codePointAt(0) > 0x2e7f ? 1.9 : 1), 0);

/** Shorten a text to a width in pixels. */
export const fitted = (text, width) => {
  let room = width / LETTER;
  if (wide(text) <= room) return text;
  room -= 1;
  let cut = "";
  for (const letter of text) {
    room -= wide(letter);
    if (room < 0) break;
    cut += letter;
  }
  return `${cut}…`;
};

/** Shade the times with a disturbance, except if the whole run is disturbed: a text states this. */
const bands = (u, cell) => {
  if (throughout(cell)) return;
  const { left, top, width, height } = u.bbox;
  u.ctx.save();
  u.ctx.fillStyle = colour("--band");
  for (const [begin, end] of cell.disturbed ?? []) {
    const from = Math.max(u.valToPos(begin, "x", true), left);
    const to = Math.min(u.valToPos(end, "x", true), left + width);
    if (to > from) u.ctx.fillRect(from, top, Math.max(to - from, 1), height);
  }
  u.ctx.restore();
};

export const throughout = ({ disturbed = [], begin, end, period_ms, unit }) => {
  const slack = unit === "cycle" ? 2 : period_ms / 500;
  return disturbed.length === 1 && disturbed[0][0] <= begin && disturbed[0][1] >= end - slack;
};

/** Set up one strip; all strips share the x scale and the cursor, and zoom by dragging. */
const strip = (root, page, cell, height, { series, scales, axes, drawn, padding }) => {
  const select = (u) => {
    const { left, width } = u.select;
    if (width < 4) return;
    const [begin, end] = [u.posToVal(left, "x"), u.posToVal(left + width, "x")];
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    page.zoom(begin, end);
  };
  const options = {
    width: Math.max(root.clientWidth, 200),
    height,
    padding: padding ?? [8, RIGHT, 0, 0],
    legend: { show: false },
    cursor: { sync: { key: "page" }, y: false, drag: { x: true, y: false, setScale: false }, points: { show: false } },
    scales: { x: { time: false, range: () => page.view }, ...scales },
    series: [{}, ...series],
    axes,
    hooks: { setSelect: [select], drawClear: [(u) => bands(u, cell)], draw: [(u) => drawn?.(u), (u) => playhead(u, page)] },
  };
  const plot = new uPlot(options, [[], ...series.map(() => [])], root);
  plot.over.addEventListener("click", (event) => {
    const box = plot.over.getBoundingClientRect();
    page.moveTo(plot.posToVal(event.clientX - box.left, "x"));
  });
  new ResizeObserver(() => {
    const width = Math.max(root.clientWidth, 200);
    if (width !== plot.width) plot.setSize({ width, height });
  }).observe(root);
  return plot;
};

const playhead = (u, page) => {
  const x = u.valToPos(page.at, "x", true);
  const { left, top, width, height } = u.bbox;
  if (page.live || x < left || x > left + width) return;
  u.ctx.save();
  u.ctx.strokeStyle = colour("--ink");
  u.ctx.lineWidth = 1.5 * devicePixelRatio;
  u.ctx.setLineDash([]);
  line(u.ctx, x, top, x, top + height);
  u.ctx.restore();
};

const line = (ctx, x1, y1, x2, y2) => {
  ctx.beginPath();
  ctx.moveTo(x1, y1);
  ctx.lineTo(x2, y2);
  ctx.stroke();
};

const axis = (more) => ({
  stroke: () => colour("--muted"),
  grid: { stroke: () => colour("--rule"), width: 1 },
  ticks: { show: false },
  font: "11.5px system-ui, sans-serif",
  ...more,
});

const across = (page, shown) =>
  axis({ size: shown ? 24 : 4, grid: { show: false }, values: shown ? page.ticks : () => [] });

const upright = (page, more = {}) => axis({ size: (u) => leftOf(page.described, u.width), ...more });

/** Latency: a bar from the smallest to the largest value of each bin, and a mark above each bin with a miss. */
const latency = (root, page, cell) => {
  let data = null;
  let top = 1;
  const drawn = (u) => {
    if (data === null) return;
    const { ctx, bbox } = u;
    const { at, low, high, missed, lost, count: counts } = data.bins;
    const ratio = devicePixelRatio;
    const x = (value) => u.valToPos(value, "x", true);
    const y = (value) => u.valToPos(Math.min(value, top), "y", true);
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour("--ink");
    ctx.globalAlpha = 0.62;
    const dot = (at.length > CROSSES ? 3 : 5) * ratio;
    ctx.lineWidth = Math.min(Math.max((0.8 * bbox.width) / Math.max(at.length, 1), 1), 3 * ratio);
    at.forEach((place, i) => {
      if (high[i] === null) return;
      if (counts[i] === 1 || high[i] - low[i] < top / 200) {
        ctx.fillRect(x(place) - dot / 2, y(high[i]) - dot / 2, dot, dot);
      } else line(ctx, x(place), y(low[i]), x(place), y(high[i]));
      // An arrow marks values above the scale.
      if (high[i] > top) triangle(ctx, x(place), bbox.top + 4 * ratio, 3.5 * ratio);
    });
    ctx.globalAlpha = 1;
    ctx.strokeStyle = ctx.fillStyle = colour("--bad");
    ctx.lineWidth = 1.5 * ratio;
    ctx.setLineDash([6 * ratio, 4 * ratio]);
    const due = y(cell.deadline_ms);
    line(ctx, bbox.left, due, bbox.left + bbox.width, due);
    ctx.setLineDash([]);
    const middle = bbox.top - 13 * ratio;
    const marked = missed.flatMap((misses, i) => (misses > 0 ? [[x(at[i]), lost[i]]] : []));
    const size = (marked.length > CROSSES ? 5 : 3.5) * ratio;
    for (const [place] of marked) {
      if (marked.length > CROSSES) line(ctx, place, middle - size, place, middle + size);
      else {
        line(ctx, place - size, middle - size, place + size, middle + size);
        line(ctx, place - size, middle + size, place + size, middle - size);
      }
    }
    ctx.fillStyle = colour("--muted");
    ctx.font = `${11.5 * ratio}px system-ui, sans-serif`;
    ctx.textAlign = "right";
    ctx.fillText("misses", bbox.left - 5 * ratio, middle + 4 * ratio);
    ctx.restore();
  };
  const plot = strip(root.querySelector(".plot"), page, cell, 190, {
    series: [{ paths: () => null, points: { show: false } }],
    scales: { y: { range: () => [0, (top = page.top(cell))] } },
    axes: [across(page, false), upright(page)],
    drawn,
    padding: [LANE + 10, RIGHT, 0, 0],
  });
  return (view) => {
    data = view;
    plot.setData([view.bins.at, view.bins.high]);
    const share = view.cycles ? ` (${percent(view.missed / view.cycles, 2)})` : "";
    const shaded = cell.disturbed?.length ? (throughout(cell) ? "; disturbed throughout" : "; shaded: disturbed") : "";
    say(root.querySelector(".said"), `${count(view.missed)} of ${count(view.cycles)} cycles missed in view${share}; dashed: the deadline, ${number(cell.deadline_ms, 1)} ms${shaded}`);
    plot.root.setAttribute("role", "img");
    plot.root.setAttribute("aria-label", `Latency: ${root.querySelector(".said").textContent}`);
    return plot;
  };
};

const triangle = (ctx, x, y, size) => {
  ctx.beginPath();
  ctx.moveTo(x, y - size);
  ctx.lineTo(x + size, y + size);
  ctx.lineTo(x - size, y + size);
  ctx.fill();
};

/** Placement: each candidate has its own lane, which identifies it without its colour. */
const ribbon = (root, page, cell) => {
  let data = null;
  const names = cell.candidates.map(({ name }) => name);
  const drawn = (u) => {
    if (data === null) return;
    const { ctx, bbox } = u;
    const lane = bbox.height / names.length;
    const { begin, end, placement } = data.ribbon;
    ctx.save();
    begin.forEach((from, i) => {
      const left = Math.max(u.valToPos(from, "x", true), bbox.left);
      const right = Math.min(u.valToPos(end[i], "x", true), bbox.left + bbox.width);
      if (placement[i] < 0) return;
      ctx.fillStyle = cell.candidates[placement[i]].hue;
      const y = bbox.top + placement[i] * lane;
      ctx.fillRect(left, y + lane * 0.16, Math.max(right - left, 1), lane * 0.68);
    });
    for (const event of data.events) {
      if (event.kind !== "guard") continue;
      const x = u.valToPos(event.at, "x", true);
      ctx.fillStyle = colour("--bad");
      triangle(ctx, x, bbox.top + 5 * devicePixelRatio, 4 * devicePixelRatio);
    }
    ctx.fillStyle = colour("--ink");
    ctx.font = `${11.5 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textAlign = "right";
    ctx.textBaseline = "middle";
    const room = bbox.left / devicePixelRatio - 8;
    names.forEach((name, i) => {
      ctx.fillText(fitted(name, room), bbox.left - 6 * devicePixelRatio, bbox.top + (i + 0.5) * lane);
    });
    ctx.restore();
  };
  const height = 12 + Math.max(names.length * 17, 34);
  const plot = strip(root.querySelector(".plot"), page, cell, height, {
    series: [{ paths: () => null, points: { show: false } }],
    scales: { y: { range: () => [0, 1] } },
    axes: [across(page, false), upright(page, { values: () => [], grid: { show: false } })],
    drawn,
    padding: [4, RIGHT, 0, 0],
  });
  return (view) => {
    data = view;
    const stretches = view.ribbon.placement;
    const used = [...new Set(stretches)].map((code) => names[code]).filter(Boolean);
    const times = Math.max(stretches.length - 1, 0);
    const changes = view.ribbon.exact ? `${times} change${times === 1 ? "" : "s"}` : "more changes than can be drawn";
    say(root.querySelector(".said"), `${used.join(", ") || "none"}; ${changes} in view`);
    plot.setData([view.bins.at, view.bins.high]);
    plot.root.setAttribute("role", "img");
    plot.root.setAttribute("aria-label", `Placement: ${root.querySelector(".said").textContent}`);
    return plot;
  };
};

/** Lines with one value per window; the legend has their names, dashes and current values. */
export const lines = (root, page, cell, height, named, { scale, written, last }) => {
  const series = named.map(({ hue, dash, width }) => ({
    stroke: () => (hue.startsWith("--") ? colour(hue) : hue),
    dash,
    width: width ?? 1.6,
    spanGaps: false,
    points: { show: (u, _, from, to) => to - from < 60, size: 4 },
  }));
  const plot = strip(root.querySelector(".plot"), page, cell, height, {
    series,
    scales: { y: scale },
    axes: [across(page, last), upright(page, { values: (_, splits) => splits.map(written) })],
  });
  const values = named.map(({ label, hue, dash, width }) => {
    const value = make("b");
    const sample = draw("line", { x1: 0, y1: 5, x2: 26, y2: 5, "stroke-width": width ?? 1.6, "stroke-dasharray": dash.join(" ") || null });
    sample.style.stroke = hue.startsWith("--") ? `var(${hue})` : hue;
    const swatch = draw("svg", { width: 26, height: 10, "aria-hidden": "true" }, sample);
    root.querySelector(".legend").append(make("li", {}, swatch, `${label} `, value));
    return value;
  });
  return {
    set: (view) => {
      plot.setData([view.windows.at, ...named.map(({ key }) => view.windows.of[key] ?? view.windows.at.map(() => null))]);
      plot.root.setAttribute("role", "img");
      plot.root.setAttribute("aria-label", root.querySelector("h3").textContent);
      return plot;
    },
    read: (found) => named.forEach(({ key }, i) => say(values[i], found(key))),
  };
};

export const charts = (root, page, cell) => {
  const part = (name) => root.querySelector(`.${name}`);
  const costs = lines(
    part("costs"),
    page,
    cell,
    130,
    [
      ...cell.candidates.map(({ name, hue }, i) => ({ key: `j ${name}`, label: name, hue, dash: DASHES[i % DASHES.length] })),
      { key: "cost", label: "seen", hue: "--ink", dash: [], width: 2.4 },
    ],
    { scale: { range: () => page.costs() }, written: (value) => number(value, 2) },
  );
  const used = lines(
    part("used"),
    page,
    cell,
    120,
    cell.resources.map(({ name, kind }, i) => ({
      key: `u ${name}`,
      label: kind === "CPU" ? name : `${name}`,
      hue: i % 2 ? "--muted" : "--ink",
      dash: DASHES[i % DASHES.length],
    })),
    { scale: { range: () => [0, page.most("used", 1)] }, written: (value) => `${Math.round(100 * value)}`, last: true },
  );
  const setters = [latency(part("latency"), page, cell), ribbon(part("ribbon"), page, cell), costs.set, used.set];
  let plots = [];
  return {
    /** Draw the data between two places. */
    set: (view) => {
      plots = setters.map((set) => set(view));
    },
    /** Write the values of a state into the legends. */
    read: (state) => {
      costs.read((key) =>
        key === "cost" ? number(state.window?.seen.cost, 2) : number(state.candidates?.[key.slice(2)]?.cost, 2),
      );
      used.read((key) => percent(state.used?.[key.slice(2)]));
    },
    redraw: () => plots.forEach((plot) => plot.redraw(false)),
    /** Ends of the y scales. */
    scales: () => plots.map(({ scales: { y } }) => [y.min, y.max]),
    /** Redraw on the scales that all cells of the page share. */
    rescale: () => plots.forEach((plot) => plot.redraw()),
  };
};

/** Extremes of a view, for scales that all cells of the page share. */
export const extremes = ({ bins, windows }) => {
  const values = (test) => Object.entries(windows.of).flatMap(([key, column]) => (test(key) ? column.filter((value) => value !== null) : []));
  const costs = values((key) => key === "cost" || key.startsWith("j "));
  return {
    latency: Math.max(...bins.high.filter((value) => value !== null), 0),
    costs: costs.length ? [Math.min(...costs), Math.max(...costs)] : null,
    used: Math.max(...values((key) => key.startsWith("u ")), 0),
  };
};

/** V_D of the second run minus V_D of the first: bars from 0, upwards if the second misses more. */
export const difference = (root, page, cell) => {
  let data = null;
  const drawn = (u) => {
    if (data === null) return;
    const { ctx, bbox } = u;
    const { begin, end, points } = data;
    ctx.save();
    begin.forEach((from, i) => {
      if (points[i] === null) return;
      const left = Math.max(u.valToPos(from, "x", true), bbox.left);
      const right = Math.min(u.valToPos(end[i], "x", true), bbox.left + bbox.width);
      const [zero, y] = [u.valToPos(0, "y", true), u.valToPos(points[i], "y", true)];
      ctx.fillStyle = colour(points[i] > 0 ? "--bad" : "--good");
      if (right > left) ctx.fillRect(left, Math.min(zero, y), Math.max(right - left - 1, 1), Math.max(Math.abs(y - zero), 1));
    });
    ctx.restore();
  };
  const range = () => {
    const most = Math.max(...(data?.points ?? []).map((value) => Math.abs(value ?? 0)), 1);
    return [-1.1 * most, 1.1 * most];
  };
  const plot = strip(root.querySelector(".plot"), page, cell, 120, {
    series: [{ paths: () => null, points: { show: false } }],
    scales: { y: { range } },
    axes: [across(page, true), upright(page)],
    drawn,
  });
  return {
    set: (view, words) => {
      data = view;
      plot.setData([view.begin, view.points]);
      say(root.querySelector(".said"), words);
      plot.root.setAttribute("role", "img");
      plot.root.setAttribute("aria-label", `Difference: ${words}`);
    },
    redraw: () => plot.redraw(false),
  };
};
