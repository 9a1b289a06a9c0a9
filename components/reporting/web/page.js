"use strict";
// Draws the figures of policies that were tried; selects and the slider draw them again.

const chosen = { lambda: null, curves: null, place: 1 };
const cellsOf = (dataset) => DATA.cells.filter((c) => c.dataset === dataset && shown(c.algorithm));
const logOf = (dataset) => DATA.logs.find((log) => log.name === dataset);
const nearest = (grid, value) => grid.reduce((best, x, n) => (Math.abs(x - value) < Math.abs(grid[best] - value) ? n : best), 0);

function drawCurves() {
  if (chosen.curves === null) return;
  const dataset = chosen.curves, level = logOf(dataset).level;
  const traces = [], ends = [], all = [];
  for (const cell of cellsOf(dataset)) {
    const n = cell.adapts ? nearest(cell.proximities, chosen.place) : 0;
    const total = cell.steps[cell.steps.length - 1];
    const x = cell.steps.map((s) => 100 * s / total);
    const y = cell.mean.map((row) => row[n]), sd = cell.sd.map((row) => row[n]);
    const name = cell.algorithm + (cell.adapts && !narrow() ? ` λ=${cell.proximities[n].toFixed(2)}` : "");
    const label = cell.steps.map((s) => s.toLocaleString("en"));
    traces.push(...line(cell.algorithm, x, y, [y.map((v, i) => (v === null ? null : v - sd[i])), y.map((v, i) => (v === null ? null : v + sd[i]))],
      { customdata: label, hovertemplate: "%{y:.1f} after %{customdata} updates<extra>" + name + "</extra>" }));
    ends.push({ name, y: y[y.length - 1], colour: colours[cell.algorithm] });
    const late = Math.floor(y.length / 2);
    for (const sign of [-1, 1]) all.push(...y.slice(late).map((v, i) => (v === null ? null : v + sign * sd[late + i])));
  }
  const best = ends.map((e) => e.y).filter((y) => y !== null);
  const limits = range([level, best.length ? Math.max(...best) : level ?? 0].filter((y) => y !== null), all);
  const shapes = [];
  if (level !== null) { shapes.push(across(level, GREY, "dash", "y")); ends.push({ name: "logged", y: level, colour: GREY }); }
  draw("figure-curves", traces, layout(`${dataset} · ${DATA.budget}`, {
    margin: named(), xaxis: axis("share of the updates (%)", { range: [0, 100] }), yaxis: axis("discounted return", { range: limits }),
    shapes, annotations: edgeNames(ends, limits, 1, "y"),
  }));
}

function drawLambda() {
  if (chosen.lambda === null) return;
  const dataset = chosen.lambda, level = logOf(dataset).level;
  const traces = [], levels = [], near = [], shapes = [], others = [];
  for (const cell of cellsOf(dataset)) {
    const last = cell.points.map((p) => p.mean);
    if (!cell.adapts) {
      others.push(last[0]);
      levels.push({ name: cell.algorithm, y: last[0], colour: colours[cell.algorithm] });
      if (last[0] !== null) shapes.push(across(last[0], colours[cell.algorithm], "dash", "y"));
      continue;
    }
    const sd = cell.points.map((p) => p.seed_std), x = cell.proximities;
    const side = (sign) => last.map((v, i) => (v === null ? null : v + sign * sd[i]));
    traces.push(...line(cell.algorithm, x, last, [side(-1), side(1)], { line: { color: colours[cell.algorithm], width: 3 },
      hovertemplate: "λ %{x:.2f}: %{y:.1f}<extra>" + cell.algorithm + "</extra>" }));
    traces.push(...line(cell.algorithm, x, cell.points.map((p) => p.distance), null, { yaxis: "y2",
      hovertemplate: "λ %{x:.2f}: distance %{y:.2f}<extra>" + cell.algorithm + "</extra>" }));
    near.push(...side(-1), ...side(1));
    levels.push({ name: cell.algorithm, y: last[last.length - 1], colour: colours[cell.algorithm] });
  }
  if (level !== null) { near.push(level); shapes.push(across(level, GREY, "dot", "y")); levels.push({ name: "logged", y: level, colour: GREY }); }
  const limits = range(near.length ? near : others, others);
  shapes.push({ type: "line", x0: chosen.place, x1: chosen.place, yref: "paper", y0: 0, y1: 1, line: { color: "#1d2430", width: 1 } });
  draw("figure-lambda", traces, layout(`${dataset} · ${DATA.budget}`, {
    margin: named(), xaxis: axis("proximity λ", { range: [0, 1], anchor: "y2" }),
    yaxis: axis("discounted return", { domain: [0.36, 1], range: limits }),
    yaxis2: axis("distance to behaviour", { domain: [0, 0.26], rangemode: "tozero" }),
    shapes, annotations: edgeNames(levels, limits, 0.64, "y"),
  }));
}

function tabulateLambda() {
  const table = document.getElementById("at-lambda");
  if (!table) return;
  const cells = DATA.cells.filter((c) => c.adapts && shown(c.algorithm));
  const cell = (tag, text, kind) => { const e = document.createElement(tag); e.textContent = text; if (kind) e.className = kind; return e; };
  const head = document.createElement("tr");
  for (const text of ["dataset", "policy"]) head.append(cell("th", text, "name"));
  for (const text of ["λ", "10th percentile", "to logged", "mean", "distance"]) head.append(cell("th", text));
  table.tHead.replaceChildren(head);
  table.tBodies[0].replaceChildren(...cells.map((c) => {
    const p = c.points[nearest(c.proximities, chosen.place)], level = c.level;
    const apart = level === null || p.tenth_percentile === null ? null : p.tenth_percentile - level;
    const row = document.createElement("tr");
    row.append(cell("td", c.dataset, "name"), cell("td", c.algorithm, "name"), cell("td", p.lambda.toFixed(2)), cell("td", fixed(p.tenth_percentile)),
      cell("td", apart === null ? "" : (apart < 0 ? "" : "+") + apart.toFixed(1), apart === null ? "" : apart < 0 ? "worse" : "better"),
      cell("td", fixed(p.mean)), cell("td", p.distance === null ? "" : p.distance.toFixed(2)));
    return row;
  }));
}

function drawThesis() {
  if (!DATA.thesis.length) return;
  const traces = [], rows = DATA.thesis.filter((r) => shown(r.algorithm));
  for (const name of new Set(rows.map((r) => r.algorithm))) {
    const own = rows.filter((r) => r.algorithm === name);
    traces.push({ name, x: own.map((r) => r.thesis), y: own.map((r) => r.here), text: own.map((r) => r.dataset), mode: "markers",
      error_x: { array: own.map((r) => r["its standard error"]), thickness: 1, width: 0 }, error_y: { array: own.map((r) => r["standard error"]), thickness: 1, width: 0 },
      marker: { color: colours[name], size: 8 }, hovertemplate: "%{text}: %{y:.1f} here, %{x:.1f} in the thesis<extra>" + name + "</extra>" });
  }
  const ends = rows.flatMap((r) => [r.here, r.thesis]), low = Math.min(...ends), high = Math.max(...ends);
  traces.push({ x: [low, high], y: [low, high], mode: "lines", line: { color: GREY, dash: "dot", width: 1 }, hoverinfo: "skip" });
  draw("figure-thesis", traces, layout("Here over the thesis · " + DATA.budget, { xaxis: axis("thesis, 10th percentile"), yaxis: axis("here, 10th percentile") }));
}

function drawAcross() {
  const a = DATA.across;
  if (!a) return;
  const kept = a.columns.map((c, n) => n).filter((n) => shown(a.columns[n].algorithm));
  const names = kept.map((n) => a.columns[n].name), tints = kept.map((n) => colours[a.columns[n].algorithm]);
  const dots = (rows, text) => ({
    x: rows.map(([e]) => e[0]), y: rows.map((row) => row[1]), mode: "markers", type: "scatter", marker: { color: rows.map((row) => row[2]), size: 10 },
    error_x: { type: "data", symmetric: false, array: rows.map(([e]) => (e[2] ?? e[0]) - e[0]), arrayminus: rows.map(([e]) => e[0] - (e[1] ?? e[0])), thickness: 1.5, color: GREY },
    hovertemplate: text + "<extra></extra>",
  });
  const tall = 110 + 26 * kept.length;
  const yaxis = axis("", { autorange: "reversed", type: "category" });
  const sorted = kept.map((n, i) => [a.middles[n], names[i], tints[i]]).sort((one, other) => other[0][0] - one[0][0]);
  draw("figure-middles", [dots(sorted, "%{y}: %{x:.3f}")],
    layout("Interquartile mean of scores · " + DATA.budget, { xaxis: axis("score"), yaxis }), tall);
  const profiles = kept.flatMap((n) => {
    const [value, low, high] = a.profiles[n], c = a.columns[n];
    const dash = { "": "solid", "0": "dot", best: "dash", 1: "solid" }[c.point];
    const band = c.point === "" || c.point === "1" ? low && [low, high] : null;
    return line(c.algorithm, a.thresholds, value, band, { line: { color: colours[c.algorithm], width: 2, dash },
      hovertemplate: "%{y:.0%} of runs above %{x:.2f}<extra>" + c.name + "</extra>" });
  });
  draw("figure-profiles", profiles, layout("Performance profiles · " + DATA.budget, { xaxis: axis("score"), yaxis: axis("share of runs above", { range: [-0.02, 1.02], tickformat: ".0%" }) }));
  const square = kept.map((i) => kept.map((j) => (i === j ? null : a.improvements[i][j][0])));
  const said = kept.map((i) => kept.map((j) => {
    if (i === j) return "";
    const [value, low, high] = a.improvements[i][j];
    return `${a.columns[i].name} beats ${a.columns[j].name}: ${(100 * value).toFixed(0)} %` + (low === null ? "" : ` (${(100 * low).toFixed(0)} to ${(100 * high).toFixed(0)})`);
  }));
  const percent = square.map((row) => row.map((share) => (share === null || narrow() ? "" : (100 * share).toFixed(0))));
  draw("figure-improvement", [{ type: "heatmap", z: square, x: names, y: names, text: percent, texttemplate: "%{text}", hovertext: said, hoverinfo: "text",
    zmin: 0, zmax: 1, xgap: 1, ygap: 1,
    colorscale: [[0, "#c2382b"], [0.5, "#ffffff"], [1, "#2b8a3e"]], colorbar: { thickness: 10, tickformat: ".0%", len: 0.9 } }],
  layout("Row beats column · " + DATA.budget, { xaxis: axis("", { type: "category", tickangle: -45 }), yaxis }), tall + 60);
  const ranks = kept.map((n) => a.ranks.mean[n]), order = kept.map((_, i) => i).sort((i, j) => ranks[i] - ranks[j]);
  const first = ranks[order[0]], reach = first + a.ranks.critical;
  draw("figure-ranks", [{ x: order.map((i) => ranks[i]), y: order.map((i) => names[i]), mode: "markers", type: "scatter",
    marker: { size: 11, color: order.map((i) => tints[i]) }, hovertemplate: "%{y}: mean rank %{x:.2f}<extra></extra>" }],
  layout("Mean ranks · " + DATA.budget, { xaxis: axis("mean rank (1 is best)"), yaxis, margin: { l: 56, r: 16, t: narrow() ? 66 : 52, b: 44 },
    shapes: [{ type: "rect", x0: first, x1: Math.min(reach, Math.max(...ranks) + 0.3), yref: "paper", y0: 0, y1: 1, fillcolor: "rgba(91,100,114,0.10)", line: { width: 0 }, layer: "below" }],
    annotations: [{ x: first, xanchor: "left", y: 1, yref: "paper", yanchor: "bottom", showarrow: false, text: "not told apart from the best", font: { size: 11, color: GREY } }] }), tall);
}

for (const select of document.querySelectorAll("[data-dataset]")) {
  const which = select.dataset.dataset;
  chosen[which] = select.value;
  select.addEventListener("change", () => { chosen[which] = select.value; (which === "lambda" ? drawLambda : drawCurves)(); });
}
for (const box of document.querySelectorAll("[data-line]")) {
  const show = () => { for (const table of document.querySelectorAll(".results")) table.classList.toggle(box.dataset.line, box.checked); };
  box.addEventListener("change", show);
  show();
}
drawers.push(drawThesis, drawAcross, drawLambda, tabulateLambda, drawCurves);

const slider = document.getElementById("slider");
if (slider) {
  slider.addEventListener("input", () => {
    chosen.place = Number(slider.value);
    document.getElementById("chosen").textContent = chosen.place.toFixed(2);
    drawLambda(); tabulateLambda(); drawCurves();
  });
}
