"use strict";
// Replaces the page's pictures with interactive figures, and sorts its tables.
(() => {
  const views = [];
  const narrow = 600;

  // A drawing was made for the page's width: parts that are wider than a small screen are fitted.
  function fit(spec, room) {
    if (room >= narrow) return spec;
    // Names of rows leave room for the marks; the pointer shows a name that is cut off.
    spec.config.axis.labelLimit = 92;
    const lone = (part) => {
      if (typeof part !== "object" || part === null) return;
      if ("columns" in part && ("facet" in part || "concat" in part)) part.columns = 1;
      if (typeof part.width === "number") part.width = Math.max(140, room - 110);
      for (const inner of ["spec", "layer", "concat", "vconcat", "hconcat"]) {
        const parts = part[inner];
        (Array.isArray(parts) ? parts : [parts]).forEach(lone);
      }
    };
    if (spec.hconcat) { spec.vconcat = spec.hconcat; delete spec.hconcat; }
    lone(spec);
    return spec;
  }

  // Lowers the indices of symbols in a drawing, as in the rest of the page: V_D.
  const symbol = new RegExp(document.body.dataset.symbol);
  function lowered(text) {
    const [first, ...parts] = text.textContent.split(symbol);
    const part = (words, style) => {
      const span = document.createElementNS(text.namespaceURI, "tspan");
      span.textContent = words;
      for (const [name, value] of Object.entries(style)) span.setAttribute(name, value);
      return span;
    };
    const written = [first];
    for (let i = 0; i < parts.length; i += 3)
      written.push(parts[i], part(parts[i + 1], { dy: ".3em", "font-size": "75%" }), part(parts[i + 2], { dy: "-.225em" }));
    if (parts.length) text.replaceChildren(...written);
  }

  function draw(figure, spec) {
    const place = document.createElement("div");
    const options = { ast: true, actions: false, renderer: "svg", hover: true };
    return vegaEmbed(place, fit(spec, figure.clientWidth), options).then((result) => {
      figure.replaceChildren(place);
      place.querySelectorAll("svg text").forEach(lowered);
      figure.classList.add("live");
      const signals = result.view.getState().signals;
      // The form chooses policies only; the lines of some figures are other things, such as links.
      views.push({ view: result.view, lines: signals.policies, seeds: "seed" in signals });
    });
  }

  // Draw the figures one by one, to keep the page responsive; folded figures when they are opened.
  async function drawAll(part) {
    for (const figure of part.querySelectorAll("[data-figure]:not(.live)")) {
      if (figure.closest("details:not([open])")) continue;
      const spec = document.querySelector(`script[data-spec="${figure.dataset.figure}"]`);
      await draw(figure, JSON.parse(spec.textContent));
    }
    choose();
  }

  const form = document.querySelector("form.choice");

  function choose() {
    if (!form) return;
    const boxes = [...form.querySelectorAll("[name=policy]")];
    const hidden = new Set(boxes.filter((box) => !box.checked).map((box) => box.value));
    const select = form.querySelector("[name=seed]");
    const seed = select && select.value !== "" ? Number(select.value) : null;
    for (const { view, lines, seeds } of views) {
      if (lines) view.signal("policies", lines.filter((name) => !hidden.has(name)));
      if (seeds) view.signal("seed", seed);
      view.runAsync();
    }
    for (const row of document.querySelectorAll("tr[data-policy]")) {
      const box = boxes.find((one) => one.value === row.dataset.policy);
      row.hidden = box !== undefined && !box.checked;
    }
  }

  if (form) {
    form.hidden = false;
    form.addEventListener("change", choose);
  }

  function compare(a, b) {
    const [x, y] = [Number(a), Number(b)];
    if (a === "" || b === "") return (a === "") - (b === "");
    return Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b) : x - y;
  }

  for (const table of document.querySelectorAll("table")) {
    const heads = [...table.tHead.rows[0].cells];
    heads.forEach((head, column) => {
      head.tabIndex = 0;
      head.setAttribute("role", "button");
      const sort = () => {
        const down = head.getAttribute("aria-sort") === "ascending";
        heads.forEach((other) => other.removeAttribute("aria-sort"));
        head.setAttribute("aria-sort", down ? "descending" : "ascending");
        for (const body of table.tBodies) {
          const rows = [...body.rows].filter((row) => !row.classList.contains("group"));
          rows.sort((a, b) => {
            const order = compare(a.cells[column].dataset.sort, b.cells[column].dataset.sort);
            return down ? -order : order;
          });
          body.append(...rows);
        }
      };
      head.addEventListener("click", sort);
      head.addEventListener("keydown", (event) => { if (event.key === "Enter") sort(); });
    });
  }

  // A link to something folded opens it.
  function unfold() {
    const target = location.hash && document.getElementById(location.hash.slice(1));
    const details = target && (target.querySelector("details") || target.closest("details"));
    if (details) { details.open = true; target.scrollIntoView(); }
  }
  addEventListener("hashchange", unfold);
  unfold();
  for (const details of document.querySelectorAll("details")) {
    details.addEventListener("toggle", () => { if (details.open) drawAll(details); });
  }
  drawAll(document);
})();
