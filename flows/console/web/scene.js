// Draws a running session on one canvas: quantities over time for both copies, and the map of the
// 2-D world. The server sends only what is new; `push` takes one step.
const OWN = "#1d4ed8", USUAL = "#94a3b8", INK = "#334155", FAINT = "#e2e8f0", BAD = "#b45309";
const WINDOW = 150; // steps that are shown

export default {
  template: `<div class="scene"><canvas role="img" :aria-label="label"></canvas><img v-show="shown" class="camera" alt="the robot" /></div>`,
  props: { strips: Array, scenery: Object, label: String },
  data: () => ({ shown: false }),
  mounted() {
    this.canvas = this.$el.querySelector("canvas");
    this.clear();
    this.arrows = [];
    this.drawn = 0; // steps drawn so far, for those who measure
    this.observer = new ResizeObserver(() => this.draw());
    this.observer.observe(this.$el);
  },
  unmounted() {
    this.observer.disconnect();
  },
  watch: {
    strips() { this.clear(); this.draw(); },
    scenery() { this.clear(); this.arrows = []; this.shown = false; this.draw(); }, // another system: the robot leaves
  },
  methods: {
    clear() {
      this.steps = [];
      this.trails = [];
    },
    push(step) {
      this.steps.push(step);
      if (this.steps.length > WINDOW) this.steps.shift();
      if (step.places) {
        if (step.fresh || !this.trails.length) this.trails.push({ own: [step.from[0]], usual: [step.from[1]] });
        const trail = this.trails[this.trails.length - 1];
        trail.own.push(step.places[0]);
        trail.usual.push(step.places[1]);
        if (this.trails.length > 5) this.trails.shift();
      }
      this.$el.dataset.steps = ++this.drawn;
      if (!this.waiting) {
        this.waiting = true;
        requestAnimationFrame(() => { this.waiting = false; this.draw(); });
      }
    },
    turn(arrows) {
      this.arrows = arrows;
      this.draw();
    },
    picture(address) {
      this.$el.querySelector("img").src = address;
      this.shown = true;
    },
    draw() {
      const width = this.$el.clientWidth;
      if (!width) return;
      const map = this.scenery.map, wide = width >= 700;
      const cells = [...this.strips.map((name, n) => ({ name, n })), { name: "λ", n: -1 }];
      const columns = map ? 1 : wide ? 2 : 1;
      const high = wide ? 112 : 92;
      const side = map ? Math.min(width, wide ? 560 : width) : 0;
      const beside = map && wide;
      const rows = Math.ceil(cells.length / columns);
      const height = beside ? side : side + rows * high + (map ? 8 : 0);
      const ratio = window.devicePixelRatio || 1;
      if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
        this.canvas.width = Math.round(width * ratio);
        this.canvas.height = Math.round(height * ratio);
        this.canvas.style.height = height + "px";
      }
      const pen = this.canvas.getContext("2d");
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.clearRect(0, 0, width, height);
      if (map) this.drawMap(pen, side);
      const left = beside ? side + 24 : 0, top = map && !beside ? side + 8 : 0;
      const span = (width - left) / columns;
      cells.forEach((cell, n) => {
        const x = left + (n % columns) * span, y = top + Math.floor(n / columns) * high;
        this.drawStrip(pen, cell, x, y, span - (columns > 1 && n % columns === 0 ? 16 : 0), high);
      });
    },
    drawStrip(pen, cell, x, y, width, high) {
      const pairs = this.steps.map((s) => (cell.n < 0 ? [s.proximity] : s.values[cell.n]));
      const known = pairs.flat().filter((v) => v !== null);
      let low = cell.n < 0 ? 0 : Math.min(...known), top = cell.n < 0 ? 1 : Math.max(...known);
      if (!known.length) { low = 0; top = 1; }
      const least = Math.max(1e-3, 0.02 * Math.abs(top));
      if (top - low < least) { const middle = (top + low) / 2; low = middle - least; top = middle + least; }
      const inner = { x: x + 46, y: y + 22, w: width - 52, h: high - 34 };
      const px = (n) => inner.x + (inner.w * n) / (WINDOW - 1);
      const py = (v) => inner.y + inner.h * (1 - (v - low) / (top - low));
      pen.font = "600 12px system-ui, sans-serif";
      pen.fillStyle = INK;
      pen.textAlign = "left";
      pen.fillText(cell.n < 0 ? "λ, familiar to better" : cell.name, inner.x, y + 14);
      pen.font = "11px system-ui, sans-serif";
      pen.fillStyle = "#64748b";
      pen.textAlign = "right";
      pen.fillText(short(top), inner.x - 6, inner.y + 8);
      pen.fillText(short(low), inner.x - 6, inner.y + inner.h);
      pen.strokeStyle = FAINT;
      pen.lineWidth = 1;
      pen.strokeRect(inner.x + 0.5, inner.y + 0.5, inner.w, inner.h);
      const last = pairs[pairs.length - 1];
      if (last) {
        pen.textAlign = "right";
        pen.font = "600 12px system-ui, sans-serif";
        let at = inner.x + inner.w;
        last.map((v, k) => [v === null ? (last.length > 1 ? "" : "–") : short(v), k ? USUAL : OWN]).reverse().forEach(([text, colour]) => {
          pen.fillStyle = colour === USUAL ? "#64748b" : colour;
          pen.fillText(text, at, y + 14);
          at -= pen.measureText(text).width + 12;
        });
      }
      [[1, USUAL, 1.5], [0, OWN, 2]].forEach(([k, colour, thick]) => {
        pen.beginPath();
        let on = false;
        pairs.forEach((pair, n) => {
          const v = pair[k];
          if (v === null || v === undefined || this.steps[n].fresh) on = false;
          if (v === null || v === undefined) return;
          on ? pen.lineTo(px(n), py(v)) : pen.moveTo(px(n), py(v));
          on = true;
        });
        pen.strokeStyle = colour;
        pen.lineWidth = thick;
        pen.lineJoin = "round";
        pen.stroke();
      });
    },
    drawMap(pen, side) {
      const S = this.scenery.side, edge = 10, size = side - 2 * edge;
      const at = ([x, y]) => [edge + (x / S) * size, edge + (1 - y / S) * size];
      const [cx, cy] = at(this.scenery.centre), sigma = (1.5 / S) * size;
      pen.save();
      pen.beginPath();
      pen.rect(edge, edge, size, size);
      pen.fillStyle = "#f8fafc";
      pen.fill();
      pen.clip();
      const glow = pen.createRadialGradient(cx, cy, 0, cx, cy, 3 * sigma);
      for (let n = 0; n <= 12; n++) glow.addColorStop(n / 12, `rgba(245, 158, 11, ${0.75 * Math.exp(-0.5 * (n / 4) ** 2)})`);
      pen.fillStyle = glow;
      pen.fillRect(edge, edge, size, size);
      pen.restore();
      pen.strokeStyle = "#cbd5e1";
      pen.strokeRect(edge + 0.5, edge + 0.5, size, size);
      pen.strokeStyle = "rgba(51, 65, 85, 0.55)";
      pen.fillStyle = "rgba(51, 65, 85, 0.55)";
      pen.lineWidth = 1.2;
      const unit = (0.6 / S) * size;
      this.arrows.forEach(([x, y, u, v]) => {
        const [px, py] = at([x, y]), far = Math.hypot(u, v);
        if (far < 0.05) return;
        const ex = px + u * unit, ey = py - v * unit, angle = Math.atan2(-v, u), head = 2.5 + 2 * Math.min(1, far);
        pen.beginPath();
        pen.moveTo(px, py);
        pen.lineTo(ex, ey);
        pen.stroke();
        pen.beginPath();
        pen.moveTo(ex + head * Math.cos(angle), ey + head * Math.sin(angle));
        pen.lineTo(ex + head * Math.cos(angle + 2.4), ey + head * Math.sin(angle + 2.4));
        pen.lineTo(ex + head * Math.cos(angle - 2.4), ey + head * Math.sin(angle - 2.4));
        pen.fill();
      });
      pen.font = "12px system-ui, sans-serif";
      pen.textAlign = "center";
      this.scenery.goals.forEach((goal) => {
        const [x, y] = at(goal);
        pen.beginPath();
        pen.arc(x, y, 9, 0, 7);
        pen.strokeStyle = "#475569";
        pen.lineWidth = 2;
        pen.stroke();
        label(pen, "familiar", x, y + 24);
      });
      pen.beginPath();
      [[-7, 0, 7, 0], [0, -7, 0, 7]].forEach(([a, b, c, d]) => { pen.moveTo(cx + a, cy + b); pen.lineTo(cx + c, cy + d); });
      pen.strokeStyle = BAD;
      pen.lineWidth = 2.5;
      pen.stroke();
      label(pen, "reward", cx, cy - 14);
      this.trails.forEach((trail, n) => {
        const now = n === this.trails.length - 1;
        pen.globalAlpha = now ? 1 : 0.12 + 0.1 * (n / this.trails.length);
        [[trail.usual, "#64748b"], [trail.own, OWN]].forEach(([places, colour]) => {
          pen.beginPath();
          places.forEach((place, k) => pen[k ? "lineTo" : "moveTo"](...at(place)));
          pen.strokeStyle = colour;
          pen.lineWidth = 2.5;
          pen.stroke();
          if (!now) return;
          pen.beginPath();
          pen.arc(...at(places[places.length - 1]), 7, 0, 7);
          pen.fillStyle = colour;
          pen.fill();
          pen.strokeStyle = "white";
          pen.lineWidth = 2;
          pen.stroke();
        });
        pen.globalAlpha = 1;
      });
    },
  },
};

function label(pen, text, x, y) {
  pen.lineWidth = 3;
  pen.strokeStyle = "rgba(255, 255, 255, 0.85)";
  pen.strokeText(text, x, y);
  pen.fillStyle = "#334155";
  pen.fillText(text, x, y);
}

function short(value) {
  if (value === null || value === undefined) return "";
  const far = Math.abs(value);
  if (far !== 0 && (far >= 10000 || far < 0.001)) return value.toExponential(1);
  return value.toFixed(far >= 100 ? 0 : far >= 10 ? 1 : 2);
}
