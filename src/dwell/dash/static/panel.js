// State of a cell in words: health, candidates, last decision, events, processes.

import { ago, count, make, number, percent, place, say } from "./dom.js";

const HEALTH = { ok: "●", degraded: "▲", stalled: "■", silent: "✕", absent: "✕", unmeasured: "○" };
const windows = (length) => `${number(length, Number.isInteger(length) ? 0 : 2)} ${length === 1 ? "window" : "windows"}`;

const REASONS = {
  dwell: (_, { dwell_cycles, window_cycles }) => `the last move is too recent; at least ${windows(dwell_cycles / window_cycles)} between moves`,
  hold: () => "no other candidate is better by enough",
  migrate: () => "another candidate is better by enough",
  capped: () => "the cheaper candidate is over a cap",
  infeasible: () => "all candidates are over a cap, this one least",
  guard: () => "the guard moved it",
};
const VERDICTS = { kept: "●", missed: "▲", open: "○" };

export const health = (root, state, stale) => {
  const word = stale ? "absent" : (state.health ?? "absent");
  const element = root.querySelector(".health");
  element.classList.toggle("ok", word === "ok");
  element.classList.toggle("bad", word !== "ok" && word !== "unmeasured");
  say(element, `${HEALTH[word] ?? "?"} ${word}${state.headline ? `: ${state.headline}` : ""}`);
};

/** Show the constant data of a cell or of a fleet. */
export const describe = (root, { about, notes, verdict, moves, never_moving, worst }) => {
  const parts = Object.entries(about).map(([name, value]) => (name === "kind" ? value : `${name} ${value}`));
  root.querySelector(".where-caption").textContent = parts.join(" · ");
  const judged = root.querySelector(".verdict");
  judged.hidden = !verdict;
  if (verdict) {
    judged.classList.toggle("ok", verdict.word === "kept");
    judged.classList.toggle("bad", verdict.word === "missed");
    judged.querySelector(".judged").textContent = `${VERDICTS[verdict.word] ?? ""} ${verdict.text}`;
    const more = [];
    if (moves) more.push(moved(moves));
    const others = Object.entries(never_moving ?? {});
    if (others.length) more.push(`without moves: ${others.map(([name, rate]) => `${name} ${percent(rate, 2)}`).join(", ")}`);
    if (worst) more.push(`worst window: ${count(worst.number)}, ${percent(worst.rate, 2)} missed`);
    judged.querySelector(".more").textContent = more.join(" · ");
  }
  root.querySelector(".notes").replaceChildren(...notes.map((text) => make("li", { text })));
};

const head = (words) =>
  make("thead", {}, make("tr", {}, ...words.map((text, i) => make("th", { scope: "col", text, class: i ? "num" : null }))));

const cells = (values) => values.map((text) => make("td", { class: "num", text }));

const moved = ({ migrations, returns, guard_moves }) => {
  const by_guard = guard_moves ? `, ${count(guard_moves)} by the guard` : "";
  return migrations || guard_moves ? `${count(migrations)} ${migrations === 1 ? "move" : "moves"}, ${count(returns)} undone${by_guard}` : "no moves";
};

/** Build the tables of decisions once; return a function that shows a state in them. */
export const decided = (root, cell, page) => {
  const rows = new Map();
  const body = make("tbody");
  const terms = [
    ["J", (value) => number(value?.cost, 2)],
    ["L95 (ms)", (value) => number(value?.l95_ms, 1)],
    ["V_D", (value) => percent(value?.violation_rate, 2)],
    ...(cell.weighs_age ? [["age (ms)", (value) => number(value?.age_ms, 1)]] : []),
    ...(cell.weighs_price ? [["price/h", (value) => number(value?.price_per_hour, 4)]] : []),
  ];
  const metrics = terms.map(([name]) => name);
  const shown = (value) => terms.map(([, text]) => text(value));
  const words = ["candidate", ...metrics, ""];
  for (const { name, hue } of cell.candidates) {
    const values = metrics.map(() => make("td", { class: "num" }));
    const mark = make("td");
    const head = make("th", { scope: "row" }, make("span", { class: "swatch", hue, "aria-hidden": "true" }), name);
    const button = page.control ? make("button", { type: "button", text: "Pin", "data-pin": name, onclick: () => page.pin(name) }) : null;
    body.append(make("tr", {}, head, ...values, mark, ...(button ? [make("td", {}, button)] : [])));
    rows.set(name, { row: body.lastChild, values, mark, button });
  }
  const caption = make("caption", { text: "Candidates, as estimated at the last close" });
  const table = make("table", { class: "candidates" }, caption, head(page.control ? [...words, ""] : words), body);
  const why = make("p", { class: "last" });
  const predicted = make("tbody");
  const against = make("table", { class: "against" }, make("caption"), head(["", ...metrics]), predicted);
  const acts = make("p", { class: "acts" });
  root.querySelector(".decided").replaceChildren(make("div", { class: "scroll" }, table), why, make("div", { class: "scroll" }, against), acts);
  if (page.control) {
    acts.append(make("button", { type: "button", text: "Unpin", "data-unpin": true, onclick: () => page.unpin() }), " ");
    for (const { name } of cell.nodes)
      acts.append(make("button", { type: "button", text: `Drain ${name}`, "data-drain": name, onclick: () => page.drain(name) }), " ");
  }
  return (state) => {
    for (const [name, { row, values, mark, button }] of rows) {
      const known = state.candidates?.[name] ?? {};
      const texts = shown(known);
      values.forEach((value, i) => say(value, texts[i]));
      row.classList.toggle("here", name === state.placement);
      const marks = [];
      if (name === state.placement) marks.push("◀ here");
      if (name === state.moving_to) marks.push("… moving there");
      if (name === state.pinned) marks.push("pinned");
      if (known.eligible === false) marks.push("over a cap");
      say(mark, marks.join(", "));
      button?.toggleAttribute("disabled", name === state.pinned);
    }
    say(why, decision(state, cell));
    const { window } = state;
    say(against.querySelector("caption"), window ? `Predicted against seen: window ${window.number}, under ${window.placement}` : "Predicted against seen: no window yet");
    const line = (name, value) => [name, ...shown(value)];
    predicted.replaceChildren(
      ...[line("predicted", state.predicted), line("seen", window?.seen)].map(([name, ...texts]) =>
        make("tr", {}, make("th", { scope: "row", text: name }), ...cells(texts)),
      ),
    );
    if (!page.control) return;
    root.querySelector("[data-unpin]").toggleAttribute("disabled", !state.pinned);
    for (const button of root.querySelectorAll("[data-drain]"))
      say(button, `${(state.drained ?? []).includes(button.dataset.drain) ? "Undrain" : "Drain"} ${button.dataset.drain}`);
  };
};

/** A decision in a few words. */
export const decided_in_words = ({ incumbent, placement, reason, refused }) => {
  const moves = placement && placement !== incumbent;
  const word = reason === "infeasible" ? REASONS.infeasible() : reason;
  return `${moves ? `${incumbent} → ${placement}` : incumbent}, ${word}${refused ? `; ✕ refused: ${refused}` : ""}`;
};

const decision = (state, cell) => {
  const { decision: last, proving } = state;
  const parts = [];
  if (last) {
    const { incumbent, placement, reason } = last;
    const moves = placement && placement !== incumbent;
    const why = REASONS[reason]?.(last, cell) ?? "see the reasons in the documentation";
    parts.push(`Last decision: ${moves ? `${incumbent} → ${placement}` : `stayed on ${incumbent}`}: ${why} (${reason}).`);
    if (last.refused) parts.push(`✕ Refused: ${last.refused}.`);
    if (last.delta_j !== null && last.delta_j !== undefined) parts.push(`ΔJ ${number(last.delta_j, 3)}.`);
  } else parts.push("No decision yet.");
  if (state.pinned) parts.push(`Pinned to ${state.pinned}; decisions of the policy have no effect.`);
  if (state.drained?.length) parts.push(`Drained: ${state.drained.join(", ")}.`);
  if (state.fallback) parts.push("The guard chose this placement.");
  if (proving) parts.push(`Proving ${proving.candidate}: ${proving.done} of ${proving.needed} probes.`);
  if (state.mode === "advise") parts.push("Mode: advise; the controller sends no orders.");
  return parts.join(" ");
};

export const facts = (root, cell, state) => {
  const parts = [];
  if (state.placement) parts.push(`placed ${state.placement}`);
  if (state.cycle !== null && state.cycle !== undefined) parts.push(`cycle ${count(state.cycle)}`);
  parts.push(`age of the command ${state.age_ms === null || state.age_ms === undefined ? "–" : `${number(state.age_ms, 0)} ms`}`);
  if (cell.live) {
    parts.push(`migrations: ${count(state.migrations ?? 0)}, moves of the guard: ${count(state.guard_moves ?? 0)}`);
    if (state.release_ratio !== null && state.release_ratio !== undefined) parts.push(`released ${percent(state.release_ratio, 0)} of P`);
    if (state.silences !== null && state.silences !== undefined) parts.push(`silences: ${count(state.silences)}`);
    parts.push(`answer of the controller ${ago(state.answer_age_ms)} old`);
    if (state.unproven) parts.push("clocks unproven");
    if (state.bound_ms !== null && state.bound_ms !== undefined) parts.push(`clocks within ${number(state.bound_ms, 1)} ms`);
  } else parts.push(`${count(cell.missed)} of ${count(cell.cycles)} cycles missed in all, warm-up included`);
  say(root.querySelector(".facts"), parts.join(" · "));
};

const LOUD = new Set(["guard", "refused", "health"]);
const MARKS = { move: "→ move", guard: "▲ guard", refused: "✕ refused", pin: "◆ pin", drain: "◇ drain", health: "! health", disturbance: "~ scenario" };

export const events = (root, cell, view, page) => {
  const list = root.querySelector(".events");
  const key = JSON.stringify([view.events, view.more_events]);
  if (list.dataset.key === String(key.length) + key.slice(-200)) return;
  list.dataset.key = String(key.length) + key.slice(-200);
  const more = view.more_events ? `; ${count(view.more_events)} earlier: zoom in` : "";
  say(root.querySelector(".events-said"), `${count(view.events.length)} in view${more}`);
  list.replaceChildren(
    ...view.events.toReversed().map((event) =>
      make(
        "li",
        {},
        make(
          "button",
          { type: "button", onclick: () => page.toWindow(event.at) },
          make("span", { text: place(event.at, cell.unit) }),
          make("span", { class: LOUD.has(event.kind) ? "kind bad" : "kind", text: MARKS[event.kind] ?? event.kind }),
          make("span", { class: "text", text: event.text }),
        ),
      ),
    ),
  );
};

const END_WORDS = ["taken", "replaced", "dropped", "lost"];

/** Show times of stages and counts of flows in the last window. */
export const stages = (root, state) => {
  const part = root.querySelector(".stages");
  const times = Object.entries(state.stages ?? {});
  part.hidden = !times.length;
  const key = JSON.stringify([state.stages, state.flows]);
  if (part.hidden || part.dataset.key === key) return;
  part.dataset.key = key;
  const rows = (body, lines) =>
    body.replaceChildren(...lines.map(([name, ...texts]) => make("tr", {}, make("th", { scope: "row", text: name }), ...cells(texts))));
  const [stage, flow] = part.querySelectorAll("tbody");
  rows(stage, times.map(([name, one]) => [name, number(one.exec_median_ms, 1), number(one.exec_p95_ms, 1), count(one.jobs), count(one.replaced), count(one.dropped)]));
  const flows = Object.entries(state.flows ?? {});
  rows(flow, flows.map(([name, one]) => [name, count(one.sent), ...END_WORDS.map((end) => count(one[end])), count(one.in_flight), number(one.bytes_per_s / 1e3, 1)]));
};

export const heard = (root, state) => {
  const part = root.querySelector(".heard");
  part.hidden = !state.processes;
  if (part.hidden) return;
  const rows = state.processes.toSorted((a, b) => a.heard - b.heard || a.who.localeCompare(b.who));
  const well = rows.filter((one) => one.heard && one.ready).length;
  say(part.querySelector(".heard-said"), `${well} of ${rows.length} heard and ready`);
  const body = part.querySelector("tbody");
  while (body.children.length > rows.length) body.lastChild.remove();
  rows.forEach((one, i) => {
    if (!body.children[i]) body.append(make("tr", {}, make("th", { scope: "row" }), make("td"), make("td", { class: "note" })));
    const [who, told, note] = body.children[i].children;
    say(who, one.who);
    const silent = one.age_ms === undefined ? "✕ never" : `✕ silent for ${ago(one.age_ms)}`;
    say(told, one.heard ? (one.ready ? "● ready" : "▲ not ready") : silent);
    say(note, one.note ?? "");
  });
};
