// Plays the frames of splats that this page carries. No library, no network: a file on a disk is enough.
const el = (id) => document.getElementById(id);
const page = JSON.parse(el("page").textContent);
const root = document.documentElement, canvas = el("stage");
const RECORD = 16, PLANES = 6, BUCKETS = 65536;

// ---------------------------------------------------------------- data
function bytesOf(node) {
  const text = atob(node.textContent.trim()), out = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
  node.remove(); // the text has been read and only takes memory
  return out;
}
async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Adds each frame's differences to the frame before; positions are differences from uniform motion, in 16 bits.
class Frames {
  constructor(range) {
    this.slots = range.slots;
    this.now = new Uint8Array(this.slots * RECORD);
    this.before = new Uint16Array(this.slots * 3);
    this.all = [];
  }
  add(planes) {
    const n = this.slots, now = this.now, short = new Uint16Array(now.buffer), before = this.before;
    for (let axis = 0; axis < 3; axis++) {
      const low = axis * n, high = (axis + 3) * n;
      for (let i = 0; i < n; i++) {
        const z = planes[low + i] | (planes[high + i] << 8), at = i * 8 + axis, last = short[at];
        short[at] = 2 * last - before[i * 3 + axis] + ((z >> 1) ^ -(z & 1));
        before[i * 3 + axis] = last;
      }
    }
    for (let k = PLANES; k < RECORD; k++) {
      const from = k * n;
      for (let i = 0; i < n; i++) now[i * RECORD + k] += planes[from + i];
    }
    this.all.push(now.slice());
  }
}

// ---------------------------------------------------------------- camera: x right, y down, z forward, as in the asset
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const along = (p, d, s) => [p[0] + s * d[0], p[1] + s * d[1], p[2] + s * d[2]];
const unit = (a) => { const l = Math.hypot(...a) || 1; return a.map((v) => v / l); };
function turned(v, axis, angle) { // Rodrigues
  const c = Math.cos(angle), s = Math.sin(angle), k = dot(axis, v) * (1 - c), x = cross(axis, v);
  return [0, 1, 2].map((i) => v[i] * c + x[i] * s + axis[i] * k);
}
const view = { right: null, down: null, forward: null, target: null, distance: 1, lens: null };
function setCamera(camera, target) {
  const [r, d, f] = camera.R, t = camera.t;
  const eye = [0, 1, 2].map((i) => -(r[i] * t[0] + d[i] * t[1] + f[i] * t[2]));
  const reach = target ? dot([0, 1, 2].map((i) => target[i] - eye[i]), f) : view.distance;
  Object.assign(view, { right: r.slice(), down: d.slice(), forward: f.slice() });
  view.distance = Math.max(reach, 1e-3);
  view.target = along(eye, f, view.distance);
  view.lens = { width: camera.width, height: camera.height, fx: camera.K[0][0], fy: camera.K[1][1], cx: camera.K[0][2], cy: camera.K[1][2] };
  dirty = true;
}
function orbit(yaw, pitch) { // radians, about the vertical through the target, and up or down without going over the top
  for (const name of ["right", "down", "forward"]) view[name] = unit(turned(view[name], [0, 0, 1], yaw));
  const fall = Math.asin(Math.max(-1, Math.min(1, -view.forward[2])));
  const tilt = Math.max(-1.55, Math.min(1.55, fall + pitch)) - fall;
  for (const name of ["down", "forward"]) view[name] = unit(turned(view[name], view.right, -tilt));
  dirty = true;
}
function pan(du, dv) {
  const lens = fitted();
  view.target = along(along(view.target, view.right, -du * view.distance / lens.fx), view.down, -dv * view.distance / lens.fy);
  dirty = true;
}
function zoom(factor) {
  view.distance = Math.min(Math.max(view.distance * factor, 0.01 * home.distance), 50 * home.distance);
  dirty = true;
}
function fitted() { // the whole of the camera's picture is seen, more beside it where the window has another shape
  const l = view.lens, k = Math.min(canvas.width / l.width, canvas.height / l.height);
  return { fx: k * l.fx, fy: k * l.fy, cx: canvas.width / 2 + k * (l.cx - l.width / 2), cy: canvas.height / 2 + k * (l.cy - l.height / 2) };
}

// ---------------------------------------------------------------- drawing
let gl = null, splats = null, ground = null, bodies = null, records = null, texture = null, order = null, corners = null, dirty = true;
function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const where = {}, count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS);
  for (let i = 0; i < count; i++) { const name = gl.getActiveUniform(made, i).name; where[name] = gl.getUniformLocation(made, name); }
  return { made, where };
}
function start() {
  gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
  if (!gl) throw new Error("this browser has no WebGL 2");
  splats = program(SPLAT_VERTEX, SPLAT_FRAGMENT);
  const n = page.range.slots, width = Math.min(1024, gl.getParameter(gl.MAX_TEXTURE_SIZE));
  records = { width, height: Math.ceil(n / width), frame: -1 };
  records.bytes = new Uint32Array(records.width * records.height * 4);
  texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, records.width, records.height);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  corners = gl.createVertexArray(); gl.bindVertexArray(corners);
  order = gl.createBuffer(); gl.bindBuffer(gl.ARRAY_BUFFER, order);
  gl.bufferData(gl.ARRAY_BUFFER, 4 * n, gl.DYNAMIC_DRAW);
  gl.enableVertexAttribArray(0); gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0); gl.vertexAttribDivisor(0, 1);
  gl.bindVertexArray(null);
}
async function startGround(parts) {
  const image = new Image(); // waited for first: frames may be drawn meanwhile, and the drawing state is shared
  if (page.terrain.textured) { image.src = el("texture").textContent.trim(); await image.decode(); }
  const made = program(GROUND_VERTEX, GROUND_FRAGMENT), array = gl.createVertexArray();
  gl.bindVertexArray(array);
  const fill = (target, data) => { gl.bindBuffer(target, gl.createBuffer()); gl.bufferData(target, data, gl.STATIC_DRAW); };
  const v = page.terrain.vertices, point = new Float32Array(parts.buffer, 0, 3 * v);
  fill(gl.ARRAY_BUFFER, point); gl.enableVertexAttribArray(0); gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
  const picture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, picture);
  if (page.terrain.textured) {
    fill(gl.ARRAY_BUFFER, new Float32Array(parts.buffer, 12 * v, 2 * v)); gl.enableVertexAttribArray(1); gl.vertexAttribPointer(1, 2, gl.FLOAT, false, 0, 0);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image); gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  } else {
    fill(gl.ARRAY_BUFFER, new Float32Array(parts.buffer, 12 * v, 3 * v)); gl.enableVertexAttribArray(2); gl.vertexAttribPointer(2, 3, gl.FLOAT, false, 0, 0);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array([255, 255, 255, 255]));
  }
  const first = (page.terrain.textured ? 20 : 24) * v;
  fill(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(parts.buffer, first, 3 * page.terrain.faces));
  gl.bindVertexArray(null);
  ground = { ...made, array, picture };
}

function startBodies(parts) { // each with points, normals and colours per vertex, then its faces
  bodies = { ...program(BODY_VERTEX, BODY_FRAGMENT), all: [] };
  let at = 0;
  for (const body of page.bodies) {
    const array = gl.createVertexArray();
    gl.bindVertexArray(array);
    for (let k = 0; k < 3; k++) {
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(parts.buffer, at, 3 * body.vertices), gl.STATIC_DRAW);
      gl.enableVertexAttribArray(k); gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 0, 0);
      at += 12 * body.vertices;
    }
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, new Uint32Array(parts.buffer, at, 3 * body.faces), gl.STATIC_DRAW);
    at += 12 * body.faces;
    gl.bindVertexArray(null);
    bodies.all.push({ array, ...body });
  }
}

// farthest first: a counting sort of the depths in 16 bits
let keys = null, sorted = null, counts = null;
function sort(frame) {
  const n = page.range.slots, place = new Uint16Array(frame.buffer), f = view.forward, s = page.range.step;
  if (!keys) { keys = new Float32Array(n); sorted = new Uint32Array(n); counts = new Uint32Array(BUCKETS + 1); }
  let near = Infinity, far = -Infinity;
  for (let i = 0; i < n; i++) {
    if (frame[i * RECORD + 15] === 0) { keys[i] = NaN; continue; }
    const k = s * (f[0] * place[i * 8] + f[1] * place[i * 8 + 1] + f[2] * place[i * 8 + 2]);
    keys[i] = k; if (k < near) near = k; if (k > far) far = k;
  }
  counts.fill(0);
  const fine = (BUCKETS - 1) / Math.max(far - near, 1e-9);
  let drawn = 0;
  for (let i = 0; i < n; i++) if (keys[i] === keys[i]) { counts[BUCKETS - 1 - ((keys[i] - near) * fine | 0) + 1]++; drawn++; }
  for (let b = 0; b < BUCKETS; b++) counts[b + 1] += counts[b];
  for (let i = 0; i < n; i++) if (keys[i] === keys[i]) sorted[counts[BUCKETS - 1 - ((keys[i] - near) * fine | 0)]++] = i;
  return drawn;
}
function uniforms(where, lens) {
  const eye = along(view.target, view.forward, -view.distance), far = view.distance + 20 * page.extent;
  gl.uniform3fv(where.eye, eye);
  gl.uniformMatrix3fv(where.turn, true, [...view.right, ...view.down, ...view.forward]);
  gl.uniform4f(where.lens, lens.fx, lens.fy, lens.cx, lens.cy);
  gl.uniform2f(where.size, canvas.width, canvas.height);
  gl.uniform2f(where.reach, Math.max(1e-3, 0.01 * view.distance), far);
}
let paint = null, showGround = true, showBodies = true;
function drawGround(lens, share) {
  gl.useProgram(ground.made); uniforms(ground.where, lens);
  gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, ground.picture);
  gl.uniform1i(ground.where.picture, 0); gl.uniform1i(ground.where.textured, page.terrain.textured ? 1 : 0);
  gl.uniform1f(ground.where.share, share);
  gl.bindVertexArray(ground.array);
  const all = () => gl.drawElements(gl.TRIANGLES, 3 * page.terrain.faces, gl.UNSIGNED_INT, 0);
  if (share < 1) { // depth first: only the nearest face is blended, once
    gl.clear(gl.DEPTH_BUFFER_BIT); gl.colorMask(false, false, false, false); all(); gl.colorMask(true, true, true, true);
    gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
  }
  gl.depthFunc(gl.LEQUAL); all(); gl.depthFunc(gl.LESS);
}
function drawBodies(lens) {
  gl.useProgram(bodies.made); uniforms(bodies.where, lens); gl.uniform3fv(bodies.where.sun, page.sun);
  for (const body of bodies.all) {
    const p = body.poses[clock.frame];
    gl.uniform3f(bodies.where.origin, p[0], p[1], p[2]); gl.uniform4f(bodies.where.pose, p[3], p[4], p[5], p[6]);
    gl.bindVertexArray(body.array);
    gl.drawElements(gl.TRIANGLES, 3 * body.faces, gl.UNSIGNED_INT, 0);
  }
}
function draw() {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const w = Math.max(1, Math.round(canvas.clientWidth * ratio)), h = Math.max(1, Math.round(canvas.clientHeight * ratio));
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const back = paint || (root.classList.contains("light") ? [243, 245, 247] : [20, 24, 29]), lens = fitted();
  gl.viewport(0, 0, w, h);
  gl.clearColor(back[0] / 255, back[1] / 255, back[2] / 255, 1);
  gl.depthMask(true); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  gl.enable(gl.DEPTH_TEST); gl.disable(gl.BLEND);
  const grounded = ground && showGround, glass = grounded && page.terrain.opacity < 1;
  if (glass) { // a vessel stands behind and before what it holds, and hides nothing of it
    drawGround(lens, Math.min(2 * page.terrain.opacity, 1)); gl.clear(gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.BLEND);
  } else if (grounded) drawGround(lens, 1);
  if (bodies && showBodies) drawBodies(lens);
  const frame = frames.all[clock.frame];
  if (frame) {
    gl.activeTexture(gl.TEXTURE0); gl.bindTexture(gl.TEXTURE_2D, texture);
    if (records.frame !== clock.frame) {
      new Uint8Array(records.bytes.buffer).set(frame);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, records.width, records.height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, records.bytes);
      records.frame = clock.frame;
    }
    const count = sort(frame);
    gl.bindBuffer(gl.ARRAY_BUFFER, order); gl.bufferSubData(gl.ARRAY_BUFFER, 0, sorted, 0, count);
    gl.useProgram(splats.made); uniforms(splats.where, lens);
    gl.uniform1i(splats.where.records, 0); gl.uniform3fv(splats.where.low, page.range.low);
    gl.uniform1f(splats.where.grain, page.range.step); gl.uniform2f(splats.where.scaled, page.range.scaleLow, page.range.scaleStep);
    gl.depthMask(false); gl.enable(gl.BLEND); gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(corners); gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, count);
  }
  if (glass) { gl.depthMask(true); drawGround(lens, page.terrain.opacity); }
  gl.bindVertexArray(null);
}

// ---------------------------------------------------------------- time and controls
const frames = new Frames(page.range), clock = { frame: 0, at: 0, playing: false, last: 0, drawn: 0 };
// until somebody touches it, the view swings to both sides, which shows that there is depth; the back is a guess
const SWING = 0.2, ROUND = 14, swing = { on: true, time: 0, yaw: 0, last: 0 }; // radians, s
function touched() { swing.on = false; }
function still() { if (swing.on) orbit(-swing.yaw, 0); touched(); }
function show(frame) {
  const last = Math.max(frames.all.length - 1, 0);
  clock.frame = Math.min(Math.max(Math.round(frame), 0), last); clock.at = clock.frame; dirty = true; tell();
}
function tell() {
  const scrub = el("scrub");
  scrub.max = page.frames - 1; scrub.value = clock.frame;
  scrub.setAttribute("aria-valuetext", `frame ${page.numbers[clock.frame]}`);
  el("time").textContent = `${page.numbers[clock.frame]} · ${(clock.frame * page.interval).toFixed(2)} s`;
}
function play(on) { clock.playing = on; clock.last = 0; el("play").textContent = on ? "pause" : "play"; }
function tick(now) {
  if (clock.playing && frames.all.length > 1) {
    if (clock.last) clock.at += (now - clock.last) / 1000 / page.interval * Number(el("speed").value);
    clock.last = now;
    // a slow machine leaves frames out: the time that passed counts, over the end and on from the beginning
    if (clock.at >= frames.all.length) clock.at = frames.all.length < page.frames ? frames.all.length - 1 : clock.at % frames.all.length;
    if (Math.floor(clock.at) !== clock.frame) { clock.frame = Math.floor(clock.at); dirty = true; tell(); }
  }
  if (swing.on && clock.playing) {
    if (swing.last) swing.time += Math.min(now - swing.last, 250) / 1000;
    const yaw = SWING * Math.sin(2 * Math.PI * swing.time / ROUND);
    orbit(yaw - swing.yaw, 0);
    Object.assign(swing, { yaw, last: now });
  }
  if (dirty && gl && !gl.isContextLost() && frames.all.length) { dirty = false; draw(); clock.drawn++; }
  requestAnimationFrame(tick);
}
function pressed(id, on) { el(id).setAttribute("aria-pressed", on); }
function theme(light) { root.classList.toggle("light", light); el("theme").textContent = light ? "dark" : "light"; dirty = true; }
function full() { if (document.fullscreenElement) document.exitFullscreen(); else document.documentElement.requestFullscreen?.(); }
let home = null;
function controls() {
  el("play").onclick = () => play(!clock.playing);
  el("scrub").oninput = (e) => { play(false); show(Number(e.target.value)); };
  el("theme").onclick = () => theme(!root.classList.contains("light"));
  el("ground").onclick = () => { showGround = !showGround; pressed("ground", showGround); dirty = true; };
  el("ground").hidden = !page.terrain;
  el("bodies").onclick = () => { showBodies = !showBodies; pressed("bodies", showBodies); dirty = true; };
  el("bodies").hidden = !page.bodies.length;
  el("full").onclick = full; el("full").hidden = !document.documentElement.requestFullscreen;
  el("view").onclick = () => setCamera(page.camera, page.target);
  for (const kind of ["pointerdown", "wheel", "keydown"]) window.addEventListener(kind, touched, { capture: true, passive: true });
  new ResizeObserver(() => { dirty = true; }).observe(canvas);
  const held = new Map();
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, [e.clientX, e.clientY]); });
  const drop = (e) => held.delete(e.pointerId);
  canvas.addEventListener("pointerup", drop); canvas.addEventListener("pointercancel", drop);
  canvas.addEventListener("pointermove", (e) => {
    const last = held.get(e.pointerId);
    if (!last) return;
    const du = e.clientX - last[0], dv = e.clientY - last[1], ratio = canvas.width / Math.max(canvas.clientWidth, 1);
    if (held.size === 1) {
      if (e.buttons & 2 || e.shiftKey || e.buttons & 4) pan(du * ratio, dv * ratio); else orbit(-du * 0.006, dv * 0.006);
    } else if (held.size === 2) { // two fingers: apart is nearer, together is aside
      const other = [...held].find(([id]) => id !== e.pointerId)[1];
      const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
      zoom(Math.max(apart(last), 1) / Math.max(apart([e.clientX, e.clientY]), 1));
      pan(0.5 * du * ratio, 0.5 * dv * ratio);
    }
    held.set(e.pointerId, [e.clientX, e.clientY]);
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(Math.max(-60, Math.min(60, e.deltaY * (e.deltaMode ? 20 : 1))) * 0.0022)); }, { passive: false });
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("dblclick", () => setCamera(page.camera, page.target));
  window.addEventListener("keydown", (e) => {
    if (e.target.tagName === "INPUT" || e.target.tagName === "SELECT") return;
    const step = { ArrowRight: 1, ArrowLeft: -1 }[e.key];
    if (e.key === " " && e.target.tagName !== "BUTTON") { e.preventDefault(); play(!clock.playing); }
    else if (step) { play(false); show(clock.frame + step); }
    else if (e.key === "h") document.body.classList.toggle("bare");
    else if (e.key === "f") full();
  });
  canvas.addEventListener("webglcontextlost", (e) => { e.preventDefault(); fail("the graphics card was taken away: load the page again"); });
}
function fail(text) { const told = el("told"); told.classList.remove("done"); told.textContent = text; told.style.display = "block"; }

async function run() {
  setCamera(page.camera, page.target); home = { distance: view.distance };
  theme(window.matchMedia("(prefers-color-scheme: light)").matches);
  el("facts").textContent += JSON.parse(el("size").textContent);
  controls(); tell(); start();
  requestAnimationFrame(tick);
  const nodes = [...document.querySelectorAll("script.frame")];
  for (let k = 0; k < nodes.length; k++) {
    frames.add(await inflated(bytesOf(nodes[k])));
    el("told").textContent = `loading ${Math.round(100 * (k + 1) / nodes.length)} %`;
    if (k === 0) {
      if (page.terrain) await startGround(await inflated(bytesOf(el("terrain"))));
      if (page.bodies.length) startBodies(await inflated(bytesOf(el("solids"))));
      dirty = true; root.classList.add("ready");
    }
    if (k % 4 === 3) await new Promise((go) => setTimeout(go, 0));
  }
  el("told").classList.add("done");
  if (!window.matchMedia("(prefers-reduced-motion: reduce)").matches) play(true);
}
// for who puts the page into one of their own, and for tests
window.fluidlift = {
  show: (k) => { still(); play(false); show(k); }, play,
  camera: (c) => { still(); setCamera(c, null); }, orbit: (yaw, pitch) => { still(); orbit(yaw, pitch); }, zoom: (by) => { still(); zoom(by); },
  terrain: (on) => { showGround = on; pressed("ground", on); dirty = true; },
  bodies: (on) => { showBodies = on; pressed("bodies", on); dirty = true; },
  background: (rgb) => { paint = rgb; dirty = true; },
  get state() { return { frame: clock.frame, loaded: frames.all.length, drawn: clock.drawn, playing: clock.playing, swinging: swing.on, yaw: swing.yaw, dirty }; },
};
window.fluidlift.ready = typeof DecompressionStream === "undefined" ? Promise.reject(new Error("this browser is too old: DecompressionStream is missing")) : run();
window.fluidlift.ready.catch((error) => { fail(String(error.message || error)); });
