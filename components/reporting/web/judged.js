"use strict";
// Draws, log by log, what judges expect of policies that were never tried, and how far these leave the log.

const JUDGES = { ensemble: "solid", critics: "dot" };
const hasDial = (curve) => curve.points.some((p) => p.proximity !== null);
const sideOf = (estimate, sign) => (estimate === null || estimate[0] === null ? null : estimate[0] + sign * (estimate[1] ?? 0));
const errorBars = (estimates, colour) => ({ type: "data", array: estimates.map((e) => (e === null ? null : e[1])), color: colour, thickness: 1, width: 3 });

function drawJudged(log, number) {
  const id = `figure-judged-${number}`;
  if (!document.getElementById(id)) return;
  const curves = log.curves.filter((c) => shown(c.algorithm));
  const dials = curves.filter(hasDial), fixedOnes = curves.filter((c) => !hasDial(c));
  const said = (x) => (x === null ? "not finite" : (x > 0 ? "+" : "") + x.toFixed(log.decimals));
  const traces = [], levels = [], shapes = [], near = [0], others = [];
  const onDial = dials.length > 0;
  // Without any λ, policies stand beside each other.
  const series = onDial ? dials.map((c) => [c.algorithm, c.points.map((p) => p.proximity), c.points])
    : fixedOnes.map((c) => [c.algorithm, [c.algorithm], c.points]);
  for (const [name, x, points] of series) {
    const colour = colours[name], at = onDial ? " at λ %{x:.2f}" : "";
    for (const [judge, dash] of Object.entries(JUDGES)) {
      const estimates = points.map((p) => p[judge]);
      if (estimates.every((e) => e === null)) continue;
      traces.push({ name: `${name}, ${judge}`, x, y: estimates.map((e) => (e === null ? null : e[0])), mode: onDial ? "lines+markers" : "markers",
        line: { color: colour, dash, width: judge === "ensemble" ? 3 : 1.6 }, error_y: errorBars(estimates, colour),
        marker: { color: judge === "ensemble" ? colour : "#fff", size: onDial ? 5 : 10, line: { color: colour, width: 1.5 }, symbol: judge === "ensemble" ? "circle" : "diamond" },
        hovertemplate: `%{y:+.${log.decimals}f} by the ${judge}${at}<extra>${name}</extra>` });
      for (const sign of [-1, 1]) near.push(...estimates.map((e) => sideOf(e, sign)));
    }
    traces.push({ name: `${name}, outside`, x, y: points.map((p) => p.outside), yaxis: "y2", type: onDial ? "scatter" : "bar", width: onDial ? undefined : 0.3,
      mode: "lines+markers", line: { color: colour, width: 2 }, marker: { color: colour, size: 5 },
      hovertemplate: `%{y:.0%} outside of the log${at}<extra>${name}</extra>` });
    const judged = points[points.length - 1], last = judged.ensemble ?? judged.critics;
    if (onDial) levels.push({ name, y: last === null ? null : last[0], text: said(last === null ? null : last[0]), colour });
  }
  if (onDial) for (const { algorithm, points: [p] } of fixedOnes) {
    for (const [judge, dash] of Object.entries(JUDGES)) {
      const y = p[judge] === null ? null : p[judge][0];
      if (y === null) continue;
      others.push(y);
      shapes.push(across(y, colours[algorithm], judge === "ensemble" ? "dash" : dash, "y"));
    }
    const level = p.ensemble ?? p.critics;
    if (level !== null && level[0] !== null) levels.push({ name: algorithm, y: level[0], text: said(level[0]), colour: colours[algorithm] });
    if (p.outside !== null) shapes.push(across(p.outside, colours[algorithm], "dash", "y2"));
  }
  const [algorithm, place] = log.best ?? [null, null];
  const curve = curves.find((c) => c.algorithm === algorithm), chosen = curve && curve.points.find((p) => p.proximity === place);
  const star = chosen ? chosen.ensemble ?? chosen.critics : null;
  if (star && star[0] !== null) {
    const x = !onDial ? algorithm : place === null ? 1 : place;
    traces.push({ name: "the judge's choice", x: [x], y: [star[0]], mode: "markers", marker: { symbol: "star", size: 16, color: colours[algorithm], line: { color: "#1d2430", width: 1 } },
      hovertemplate: `${said(star[0])}: what the judge would choose<extra>${algorithm}</extra>` });
    near.push(star[0]);
  }
  const limits = range(near, others);
  shapes.push(across(0, GREY, "solid", "y"), across(log.far, GREY, "dash", "y2"));
  levels.push({ name: "logged", y: 0, text: "", colour: GREY });
  draw(id, traces, layout(`${log.name} · ${DATA.budget}`, {
    ...(onDial ? { margin: named() } : {}), barmode: "overlay",
    xaxis: axis(onDial ? "proximity λ" : "", onDial ? { range: [-0.02, 1.02], anchor: "y2" } : { type: "category", anchor: "y2" }),
    yaxis: axis("expected gain", { domain: [0.36, 1], range: limits }),
    yaxis2: axis("outside the log", { domain: [0, 0.26], range: [-0.03, 1.03], tickformat: ".0%" }),
    shapes, annotations: [...(onDial ? edgeNames(levels, limits, 0.64, "y") : []), { text: "warning", x: onDial ? 1 : 0, xref: "paper", xanchor: "left", xshift: 4,
      y: log.far, yref: "y2", yanchor: onDial ? "middle" : "bottom", showarrow: false, font: { size: narrow() ? 9.5 : 11, color: GREY } }],
  }));
}

drawers.push(() => DATA.judged.forEach(drawJudged));
