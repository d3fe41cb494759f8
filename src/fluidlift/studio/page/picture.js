// The clip with what was found and what was said on it, and the tools that draw. Points are px of the clip's own picture.
const COLORS = { fluid: "#1ea0ff", "not fluid": "#ff5a4d", rock: "#ff9a2e", sky: "#b9a3ff", ledge: "#2fd3c9", pool: "#3c6cff" };
const MINE = "#5dff9b"; // of lines that a person drew
const NEAR = 12; // px of the screen within which a handle is taken

export class Picture {
  constructor(canvas, page, doing) {
    Object.assign(this, { canvas, page, ...doing });
    this.context = canvas.getContext("2d");
    this.frames = []; this.masks = []; this.keys = { frames: 0, masks: 0 };
    this.number = 0; this.running = false; this.line = null; this.held = null; this.first = null;
    this.told = () => {};
    new ResizeObserver(() => this.draw()).observe(canvas);
    canvas.addEventListener("pointerdown", (e) => this.down(e));
    canvas.addEventListener("pointermove", (e) => this.move(e));
    canvas.addEventListener("pointerup", (e) => this.up(e));
    canvas.addEventListener("dblclick", () => this.finish());
  }

  get state() { return this.page.state; }
  get size() { return this.state?.clip?.size ?? null; }
  get times() { return this.state?.look?.times ?? []; }
  get hints() { return this.state?.hints ?? {}; }
  get facts() { return this.state?.look?.facts ?? null; }

  take(state) {
    const name = state.clip?.name;
    if (this.name !== name) {
      this.name = name; this.frames = []; this.masks = []; this.keys = { frames: 0, masks: 0 };
      this.number = 0; this.line = null; this.held = null; this.first = null; this.running = false;
    }
    if (state.strip.first && !this.first) {
      this.first = new Image();
      this.first.onload = () => this.draw();
      this.first.src = `first.jpg?${encodeURIComponent(name)}`;
    }
    this.load("frames", state.look?.pictures ?? 0, "jpg");
    this.load("masks", state.look?.masks ?? 0, "png");
    this.show(Math.min(this.number, Math.max(0, this.times.length - 1)));
  }

  // a new set of pictures: the one in view first, and each in the place of the old one once it is there
  load(what, key, suffix) {
    const count = this.times.length;
    if (!key || !count || key === this.keys[what]) return;
    this.keys[what] = key;
    if (what === "frames") this.frames = [];
    if (this[what].length > count) this[what].length = count;
    const order = [...Array(count).keys()].sort((a, b) => Math.abs(a - this.number) - Math.abs(b - this.number));
    const next = () => {
      const k = order.shift();
      if (k === undefined || this.keys[what] !== key) return;
      const image = new Image();
      image.of = key;
      image.onload = () => { if (this.keys[what] === key) { this[what][k] = image; if (k === this.number) this.draw(); } next(); };
      image.onerror = next;
      image.src = `${what}/${key}/${k}.${suffix}`;
    };
    for (let lanes = 0; lanes < 3; lanes++) next();
  }

  show(number) {
    const last = this.times.length - 1;
    this.number = Math.max(0, Math.min(last, number));
    if (last < 0) this.number = 0;
    this.told(this.number, last < 0 ? null : this.times[this.number], this.running);
    this.draw();
  }

  toggle() {
    this.running = !this.running && this.times.length > 1;
    this.told(this.number, this.times[this.number] ?? null, this.running);
    let last = null, shown = this.times[this.number];
    const tick = (now) => {
      if (!this.running) return;
      if (last !== null) shown += (now - last) / 1000;
      last = now;
      const end = this.times[this.times.length - 1];
      if (shown > end) shown = this.times[0];
      let k = this.times.findIndex((t) => t > shown) - 1;
      if (k < 0) k = 0;
      if (k !== this.number) this.show(k);
      requestAnimationFrame(tick);
    };
    if (this.running) requestAnimationFrame(tick);
  }

  // which pictures stand on the canvas: the key of each set that the frame in view is of
  drawn() {
    const there = (what) => (this[what][this.number] ? this[what][this.number].of : 0);
    return { first: this.first?.naturalWidth ?? 0, frames: there("frames"), masks: there("masks") };
  }

  // where the picture lies on the canvas; smaller while the horizon is drawn, which may be far outside
  place() {
    const box = this.canvas.getBoundingClientRect(), [w, h] = this.size ?? [16, 9];
    const part = this.page.tool === "horizon" ? 0.4 : 1;
    const scale = part * Math.min(box.width / w, box.height / h);
    return { box, scale, left: (box.width - scale * w) / 2, top: (box.height - scale * h) / 2 };
  }

  at(e) {
    const { box, scale, left, top } = this.place();
    return [(e.clientX - box.left - left) / scale, (e.clientY - box.top - top) / scale];
  }

  near(a, b) { return Math.hypot(a[0] - b[0], a[1] - b[1]) * this.place().scale < NEAR; }

  // what can be dragged with the tool: name and place
  handles() {
    const [w, h] = this.size ?? [1, 1];
    if (this.page.tool === "horizon") {
      const ends = this.hints.horizon ?? this.facts?.horizon ?? [[0, h / 3], [w, h / 3]];
      const inside = (p) => [p[0], Math.max(-0.7 * h, Math.min(1.7 * h, p[1]))];
      return ends.map((p, k) => ({ kind: "horizon", k, at: inside(p) }));
    }
    if (this.page.tool === "rim") {
      return (this.hints.rims ?? []).flatMap((r, k) => {
        const c = Math.cos(((r.turned ?? 0) * Math.PI) / 180), s = Math.sin(((r.turned ?? 0) * Math.PI) / 180);
        return [
          { kind: "rim-center", k, at: r.center },
          { kind: "rim-long", k, at: [r.center[0] + r.axes[0] * c, r.center[1] + r.axes[0] * s] },
          { kind: "rim-short", k, at: [r.center[0] - r.axes[1] * s, r.center[1] + r.axes[1] * c] },
        ];
      });
    }
    if (this.page.tool === "arrow") {
      const mine = (this.hints.flow ?? []).flatMap((a, k) => [{ kind: "arrow-to", k, at: a.to }, { kind: "arrow-at", k, at: a.at }]);
      return [...mine, ...this.foundArrows().map((a) => ({ kind: "arrow-found", from: a.at, at: a.to }))];
    }
    if (this.page.tool === "level" && this.hints.level) {
      return this.hints.level.map((p, k) => ({ kind: "level", k, at: p }));
    }
    if (this.page.tool === "ruler" && this.hints.ruler) {
      return ["from", "to"].map((k) => ({ kind: "ruler", k, at: this.hints.ruler[k] }));
    }
    return [];
  }

  // the arrows that were found; beside one that was drawn there is none
  foundArrows() {
    const near = this.size[0] / 14;
    return (this.facts?.flow ?? []).filter((f) => !(this.hints.flow ?? []).some((a) => Math.hypot(a.at[0] - f.at[0], a.at[1] - f.at[1]) < near));
  }

  down(e) {
    if (!this.size || e.button !== 0 || !this.state.hints) return;
    this.canvas.focus({ preventScroll: true });
    const p = this.at(e), tool = this.page.tool;
    if (tool === "look") { this.toggle(); return; }
    this.running = false;
    this.held = this.handles().find((x) => this.near(x.at, p)) ?? null;
    this.canvas.setPointerCapture(e.pointerId);
    if (tool === "area") {
      if (this.line && this.line.length > 2 && this.near(this.line[0], p)) this.finish();
      else this.line = [...(this.line ?? []), p];
    } else if (tool === "click") {
      this.change({ add: "clicks", item: { at: p, fluid: this.page.what === "fluid" } });
    } else if (tool === "brush") {
      this.line = [p];
    } else if (this.held) {
      this.line = this.held.kind === "horizon" ? this.handles().map((x) => x.at) : null;
    } else if (["ruler", "rim", "arrow", "level"].includes(tool)) {
      this.line = [p, p];
    }
    this.draw();
  }

  move(e) {
    if (!this.size) return;
    const p = this.at(e);
    this.pointer = p;
    if (this.held?.kind === "horizon") this.line[this.held.k] = p;
    else if (this.held) this.held.at = p;
    else if (e.buttons && this.line && this.page.tool === "brush") {
      const last = this.line[this.line.length - 1];
      if (Math.hypot(p[0] - last[0], p[1] - last[1]) > Math.max(2, this.page.width / 8)) this.line.push(p);
    } else if (e.buttons && this.line && ["ruler", "rim", "arrow", "level"].includes(this.page.tool)) this.line[1] = p;
    if (this.held || this.line || this.page.tool === "brush") this.draw();
  }

  up() {
    const tool = this.page.tool, line = this.line, held = this.held;
    this.held = null;
    if (tool === "area") return;
    this.line = null;
    if (held?.kind === "horizon") this.change({ set: ["horizon", "pitch"], to: [line, null] });
    else if (held?.kind === "ruler") this.change({ set: "ruler", to: { ...this.hints.ruler, [held.k]: held.at } });
    else if (held?.kind === "level") this.change({ set: "level", to: this.hints.level.map((p, k) => (k === held.k ? held.at : p)) });
    else if (held?.kind.startsWith("arrow")) this.turnArrow(held);
    else if (held) this.moveRim(held);
    else if (line && tool === "arrow" && this.long(line)) this.change({ add: "flow", item: { at: line[0], to: line[1] } });
    else if (line && tool === "level" && this.long(line)) this.change({ set: "level", to: line });
    else if (line && tool === "brush") this.sendRegion({ brush: line, width: this.page.width });
    else if (line && tool === "ruler" && this.long(line)) this.change({ set: "ruler", to: { from: line[0], to: line[1], metres: this.page.metres } });
    else if (line && tool === "rim" && this.long(line)) {
      const [a, b] = line;
      this.change({ add: "rims", item: { center: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], axes: [Math.abs(a[0] - b[0]) / 2, Math.max(1, Math.abs(a[1] - b[1]) / 2)] } });
    }
    this.draw();
  }

  long([a, b]) { return Math.hypot(a[0] - b[0], a[1] - b[1]) > 4; }

  // an arrow that was found and is turned becomes one that was drawn; one is moved by its tail as a whole
  turnArrow({ kind, k, at, from }) {
    if (kind === "arrow-found") {
      if (this.long([from, at])) this.change({ add: "flow", item: { at: from, to: at } });
      return;
    }
    const arrow = this.hints.flow[k];
    const moved = kind === "arrow-to" ? { at: arrow.at, to: at } : { at, to: [arrow.to[0] + at[0] - arrow.at[0], arrow.to[1] + at[1] - arrow.at[1]] };
    if (this.long([moved.at, moved.to])) this.change({ put: "flow", at: k, item: moved });
  }

  moveRim({ kind, k, at }) {
    const rim = { ...this.hints.rims[k] }, dx = at[0] - rim.center[0], dy = at[1] - rim.center[1];
    if (kind === "rim-center") rim.center = at;
    else if (kind === "rim-long") { rim.axes = [Math.max(2, Math.hypot(dx, dy)), rim.axes[1]]; rim.turned = (Math.atan2(dy, dx) * 180) / Math.PI; }
    else rim.axes = [rim.axes[0], Math.max(2, Math.hypot(dx, dy))];
    this.change({ put: "rims", at: k, item: rim });
  }

  sendRegion(line) {
    const region = { is: this.page.what, ...line, time: this.times[this.number] ?? 0 };
    if (this.page.moves) region.moves = true;
    if (this.page.begins) region.from = region.time;
    this.change({ add: "regions", item: region });
  }

  // all that lies so far is taken away: what is painted after it is all there is
  clearMask() {
    const [w, h] = this.size;
    this.change({ add: "regions", item: { is: "not fluid", area: [[0, 0], [w, 0], [w, h], [0, h]] } });
  }

  finish() {
    if (this.page.tool !== "area" || !this.line) return;
    // a double click has set its corner twice
    const line = this.line.filter((p, k) => k === 0 || Math.hypot(p[0] - this.line[k - 1][0], p[1] - this.line[k - 1][1]) > 1);
    this.line = null;
    if (line.length > 2) this.sendRegion({ area: line });
    this.draw();
  }

  cancel() { this.line = null; this.held = null; this.draw(); }
  changeTool() { this.cancel(); }

  draw() {
    const c = this.context, { box, scale, left, top } = this.place(), ratio = window.devicePixelRatio || 1;
    if (!box.width) return;
    const [W, H] = [Math.round(box.width * ratio), Math.round(box.height * ratio)];
    if (this.canvas.width !== W || this.canvas.height !== H) { this.canvas.width = W; this.canvas.height = H; }
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, box.width, box.height);
    if (!this.size) return;
    const [w, h] = this.size, shown = (id) => document.getElementById(id).checked;
    const frame = this.frames[this.number] ?? this.first;
    if (frame?.complete && frame.naturalWidth) c.drawImage(frame, left, top, scale * w, scale * h);
    const mask = this.masks[this.number];
    if (mask && shown("show-mask")) c.drawImage(mask, left, top, scale * w, scale * h);
    c.translate(left, top); c.scale(scale, scale);
    this.unit = 1 / scale;
    if (shown("show-arrows")) this.drawArrows(c);
    if (shown("show-lines")) this.drawLines(c);
    this.drawTool(c);
  }

  drawArrows(c) {
    c.strokeStyle = "rgba(255,255,255,0.95)"; c.lineWidth = 1.6 * this.unit;
    const turned = this.held?.kind === "arrow-found" ? this.held.from : null;
    for (const { at, to } of this.foundArrows()) if (at !== turned) this.arrow(c, at, to);
    c.strokeStyle = MINE; c.lineWidth = 3 * this.unit;
    (this.hints.flow ?? []).forEach(({ at, to }, k) => {
      const held = this.held?.k === k && this.held.kind.startsWith("arrow-") ? this.held : null;
      if (held?.kind === "arrow-at") this.arrow(c, held.at, [to[0] + held.at[0] - at[0], to[1] + held.at[1] - at[1]]);
      else this.arrow(c, at, held ? held.at : to);
    });
    if (turned) this.arrow(c, turned, this.held.at);
  }

  arrow(c, a, b) {
    const d = Math.hypot(b[0] - a[0], b[1] - a[1]), tip = Math.min(0.4 * d, 7 * this.unit), angle = Math.atan2(b[1] - a[1], b[0] - a[0]);
    c.beginPath(); c.moveTo(...a); c.lineTo(...b);
    for (const side of [2.6, -2.6]) { c.moveTo(...b); c.lineTo(b[0] + tip * Math.cos(angle + side), b[1] + tip * Math.sin(angle + side)); }
    c.stroke();
  }

  path(c, points, closed) {
    c.beginPath();
    points.forEach((p, k) => (k ? c.lineTo(...p) : c.moveTo(...p)));
    if (closed) c.closePath();
  }

  drawLines(c) {
    const now = this.times[this.number] ?? 0, waiting = !!this.state.look?.words, u = this.unit, [w, h] = this.size;
    c.save(); c.beginPath(); c.rect(0, 0, w, h); c.clip();
    for (const r of this.hints.regions ?? []) {
      if (r.moves && Math.abs((r.time ?? 0) - now) > 0.02) continue;
      if (now < (r.from ?? -1) - 0.001 || now >= (r.until ?? 1e9) - 0.001) continue;
      c.strokeStyle = c.fillStyle = COLORS[r.is]; c.lineJoin = c.lineCap = "round";
      if (r.area) { this.path(c, r.area, true); c.lineWidth = 1.5 * u; c.stroke(); if (waiting) { c.globalAlpha = 0.35; c.fill(); c.globalAlpha = 1; } }
      else { this.path(c, r.brush.length > 1 ? r.brush : [r.brush[0], r.brush[0]], false); c.globalAlpha = waiting ? 0.45 : 0.12; c.lineWidth = r.width; c.stroke(); c.globalAlpha = 1; }
    }
    c.restore();
    for (const k of this.hints.clicks ?? []) this.dot(c, k.at, k.fluid ? COLORS.fluid : COLORS["not fluid"], 5);
    for (const r of this.hints.rims ?? []) this.ellipse(c, r, "#ffe14d", []);
    if (!this.hints.rims) for (const r of this.facts?.rims ?? []) this.ellipse(c, r, "#ffe14d", [5 * u, 5 * u]);
    this.drawFoundLines(c);
    this.drawPath(c);
    const level = this.hints.level;
    if (level) {
      const held = this.held?.kind === "level" ? this.held : null;
      c.strokeStyle = COLORS.pool; c.lineWidth = 3 * u;
      this.path(c, level.map((p, k) => (held?.k === k ? held.at : p)), false); c.stroke();
    }
    const ruler = this.hints.ruler;
    if (ruler) this.measure(c, ruler.from, ruler.to, `${ruler.metres} m`);
    const horizon = this.page.tool === "horizon" ? this.handles().map((x) => x.at) : (this.hints.horizon ?? this.facts?.horizon);
    if (horizon && !(this.page.tool === "horizon" && this.line)) this.drawHorizon(c, horizon, !this.hints.horizon);
  }

  // ledges, levels and the vessel as found: dashed, as all that was not said; and how sure they are
  drawFoundLines(c) {
    const u = this.unit, facts = this.facts;
    if (!facts) return;
    c.lineWidth = 2 * u; c.lineJoin = "round";
    for (const { is, line } of facts.lines ?? []) {
      c.strokeStyle = is === "level" ? COLORS.pool : COLORS.ledge;
      c.setLineDash(is === "crest" ? [] : [7 * u, 5 * u]);
      this.path(c, line, false); c.stroke();
    }
    c.setLineDash([7 * u, 5 * u]); c.font = `bold ${13 * u}px system-ui`;
    for (const { is, area, probability } of facts.parts ?? []) {
      if (!area) continue;
      c.strokeStyle = c.fillStyle = is === "ledge" ? COLORS.ledge : is === "pool" ? COLORS.pool : "#ffe14d";
      if (is === "jet" || is === "vessel") { this.path(c, area, true); c.stroke(); }
      const top = area.reduce((a, b) => (b[1] < a[1] ? b : a)), text = `${is} ${probability.toFixed(2)}`;
      const x = Math.max(2 * u, Math.min(this.size[0] - c.measureText(text).width - 2 * u, top[0])), y = Math.max(14 * u, top[1] - 6 * u);
      c.save(); c.setLineDash([]); c.lineWidth = 4 * u; c.strokeStyle = c.fillStyle; c.strokeText(text, x, y);
      c.fillStyle = "#10202a"; c.fillText(text, x, y); c.restore();
    }
    c.setLineDash([]);
  }

  // where the middle of the frames lay on the steady picture, as the camera moved; a dot is the frame in view
  drawPath(c) {
    const camera = this.state.look?.so_far?.camera ?? this.facts?.camera, u = this.unit;
    if (!camera?.path) return;
    c.strokeStyle = "#ff6bd6"; c.lineWidth = 2 * u; c.lineJoin = "round";
    this.path(c, camera.path, false); c.stroke();
    const now = this.times[this.number] ?? 0;
    const k = camera.times.reduce((best, t, i) => (Math.abs(t - now) < Math.abs(camera.times[best] - now) ? i : best), 0);
    this.dot(c, camera.path[k], "#ff6bd6", 4);
  }

  drawHorizon(c, [a, b], guessed) {
    const u = this.unit, slope = (b[1] - a[1]) / Math.max(1e-6, b[0] - a[0]), [w] = this.size;
    const y = (x) => a[1] + slope * (x - a[0]);
    c.setLineDash(guessed ? [8 * u, 6 * u] : []); c.strokeStyle = "#5dff9b"; c.lineWidth = 2 * u;
    c.beginPath(); c.moveTo(-2 * w, y(-2 * w)); c.lineTo(3 * w, y(3 * w)); c.stroke(); c.setLineDash([]);
  }

  ellipse(c, r, color, dash) {
    c.strokeStyle = color; c.lineWidth = 2 * this.unit; c.setLineDash(dash);
    c.beginPath(); c.ellipse(r.center[0], r.center[1], r.axes[0], r.axes[1], ((r.turned ?? 0) * Math.PI) / 180, 0, 2 * Math.PI); c.stroke(); c.setLineDash([]);
  }

  measure(c, a, b, text) {
    const u = this.unit;
    c.strokeStyle = c.fillStyle = "#ffe14d"; c.lineWidth = 3 * u;
    this.path(c, [a, b], false); c.stroke();
    c.font = `${14 * u}px system-ui`; c.fillText(text, (a[0] + b[0]) / 2, (a[1] + b[1]) / 2 - 8 * u);
  }

  dot(c, p, color, radius) {
    c.fillStyle = color; c.strokeStyle = "#fff"; c.lineWidth = 1.5 * this.unit;
    c.beginPath(); c.arc(p[0], p[1], radius * this.unit, 0, 2 * Math.PI); c.fill(); c.stroke();
  }

  drawTool(c) {
    const u = this.unit, color = COLORS[this.page.what], tool = this.page.tool;
    if (tool === "brush" && this.line) {
      c.strokeStyle = color; c.lineJoin = c.lineCap = "round"; c.lineWidth = this.page.width; c.globalAlpha = 0.55;
      this.path(c, this.line.length > 1 ? this.line : [this.line[0], this.line[0]], false); c.stroke(); c.globalAlpha = 1;
    } else if (tool === "brush" && this.pointer) {
      c.strokeStyle = "#fff"; c.lineWidth = u; c.beginPath(); c.arc(...this.pointer, this.page.width / 2, 0, 2 * Math.PI); c.stroke();
    } else if (tool === "area" && this.line) {
      c.strokeStyle = color; c.lineWidth = 2 * u; this.path(c, [...this.line, ...(this.pointer ? [this.pointer] : [])], false); c.stroke();
      for (const p of this.line) this.dot(c, p, color, 4);
    } else if (tool === "ruler" && this.line) this.measure(c, this.line[0], this.line[1], `${this.page.metres} m`);
    else if (tool === "rim" && this.line) {
      const [a, b] = this.line;
      this.ellipse(c, { center: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], axes: [Math.abs(a[0] - b[0]) / 2, Math.abs(a[1] - b[1]) / 2] }, "#ffe14d", []);
    } else if (tool === "arrow" && this.line) {
      c.strokeStyle = MINE; c.lineWidth = 3 * u; this.arrow(c, ...this.line);
    } else if (tool === "level" && this.line) {
      c.strokeStyle = COLORS.pool; c.lineWidth = 3 * u; this.path(c, this.line, false); c.stroke();
    } else if (tool === "horizon" && this.line) this.drawHorizon(c, this.line, false);
    const held = this.held && this.held.kind !== "horizon" ? [this.held] : [];
    const handles = tool === "horizon" && this.line ? this.line.map((at) => ({ at })) : this.handles();
    for (const x of [...handles, ...held]) this.dot(c, x.at, MINE, x.kind === "arrow-found" ? 4 : 6);
  }
}
