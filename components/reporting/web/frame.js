"use strict";
// What figures are drawn with, from the numbers in #data. A page adds its own to `drawers`; toggles draw all again.

const DATA = JSON.parse(document.getElementById("data").textContent);
const hidden = new Set();
const drawers = [];
const CONFIG = { responsive: true, displaylogo: false, modeBarButtonsToRemove: ["select2d", "lasso2d"] };
const GREY = "#5b6472";
const colours = Object.fromEntries(DATA.algorithms.map((a) => [a.name, a.colour]));
const narrow = () => window.innerWidth < 640;
const shown = (algorithm) => !hidden.has(algorithm);
const fixed = (x, digits = 1) => (x === null ? "not finite" : x.toFixed(digits));

function faded(colour, alpha) {
  const part = (from) => parseInt(colour.slice(from, from + 2), 16);
  return `rgba(${part(1)},${part(3)},${part(5)},${alpha})`;
}

function layout(title, more) {
  return Object.assign({
    title: { text: narrow() ? title.replace(" · ", "<br>") : title, font: { size: narrow() ? 12 : 15 }, x: 0, xanchor: "left", xref: "paper" },
    margin: { l: 56, r: narrow() ? 8 : 16, t: narrow() ? 50 : 36, b: 44 }, showlegend: false, hovermode: "closest",
    font: { family: "system-ui, Segoe UI, DejaVu Sans, sans-serif", size: 12, color: "#1d2430" },
    paper_bgcolor: "#fff", plot_bgcolor: "#fff",
  }, more);
}
const axis = (text, more) => Object.assign({ title: { text, standoff: 8 }, gridcolor: "#eceff2", zeroline: false, automargin: true }, more);

function draw(id, traces, plan, height) {
  const place = document.getElementById(id);
  if (!place) return;
  if (height) place.style.height = `${height}px`;
  Plotly.react(place, traces, plan, CONFIG);
}

function line(name, x, y, band, more) {
  const usual = { name, x, y, mode: "lines", line: { color: colours[name], width: 2 }, hovertemplate: "%{y:.1f}<extra>" + name + "</extra>" };
  const traces = [Object.assign(usual, more)];
  if (band) {
    const [low, high] = band;
    traces.unshift({ x: x.concat([...x].reverse()), y: high.concat([...low].reverse()), fill: "toself", mode: "lines",
      line: { width: 0 }, fillcolor: faded(colours[name], 0.14), hoverinfo: "skip", yaxis: usual.yaxis, xaxis: usual.xaxis });
  }
  return traces;
}

// The range that shows differences: what is far below would squeeze all others together.
function range(near, others) {
  const known = near.filter((y) => y !== null);
  let low = Math.min(...known), high = Math.max(...known);
  const far = low - Math.max(high - low, 1);
  for (const y of others) if (y !== null && y >= far) { low = Math.min(low, y); high = Math.max(high, y); }
  const margin = 0.06 * (high - low) || 1;
  return [low - margin, high + margin];
}

// Names of levels to the right of the axes, apart from each other; what is off the axis says so.
function edgeNames(levels, [low, high], share, yref) {
  const step = (high - low) * 0.04 / share;
  const placed = levels.filter((l) => l.y !== null)
    .map((l) => ({ ...l, at: Math.min(Math.max(l.y, low), high) })).sort((a, b) => a.at - b.at);
  placed.forEach((l, n) => { if (n) l.at = Math.max(l.at, placed[n - 1].at + step); });
  let top = high;
  for (const l of [...placed].reverse()) { l.at = Math.min(l.at, top); top = l.at - step; }
  return placed.map((l) => ({
    x: 1, xref: "paper", xshift: 4, y: l.at, yref, xanchor: "left", yanchor: "middle", showarrow: false,
    font: { size: narrow() ? 9.5 : 11, color: l.colour },
    text: `${l.name} ${l.text ?? fixed(l.y, narrow() ? 0 : 1)}` + (l.y < low ? " ↓" : l.y > high ? " ↑" : ""),
  }));
}
// Room for these names.
const named = () => ({ l: 56, r: narrow() ? 96 : 170, t: narrow() ? 50 : 36, b: 44 });

const across = (y, colour, dash, yref) => ({ type: "line", xref: "paper", x0: 0, x1: 1, y0: y, y1: y, yref, line: { color: colour, dash, width: 1.4 } });

function showColumns() {
  for (const place of document.querySelectorAll("[data-a]")) place.classList.toggle("hidden", hidden.has(place.dataset.a));
}

function drawAll() { showColumns(); for (const drawOne of drawers) drawOne(); }

for (const button of document.querySelectorAll("[data-toggle]")) {
  button.addEventListener("click", () => {
    const name = button.dataset.toggle;
    if (!hidden.delete(name)) hidden.add(name);
    button.setAttribute("aria-pressed", String(!hidden.has(name)));
    drawAll();
  });
}
