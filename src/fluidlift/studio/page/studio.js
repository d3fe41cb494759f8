// What the page shows follows from one state that the server tells; what a person does goes there as one step.
import { Picture } from "./picture.js";
import { el, fill, panels } from "./panels.js";

export const page = { state: null, tool: "look", what: "fluid", width: 24, moves: false, begins: false, metres: 1 };
const REGIONS = ["fluid", "not fluid", "rock", "sky", "ledge", "pool"];
const $ = (id) => document.getElementById(id);
let messageOf = "";

export function say(text) {
  messageOf = text;
  message();
}

// an answer may come after the state that it led to: where it has nothing to say, the trouble of that state stays
function message() {
  const text = messageOf || page.state?.error || page.state?.look?.error || "";
  $("message").textContent = text;
  $("message").hidden = !text;
}

export async function act(what, data = {}) {
  const answer = await fetch(`do/${what}`, {
    method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(data),
  });
  const told = await answer.json();
  say(told.error || "");
  return told;
}

export const change = (data) => act("change", data);

export async function addClip(file) {
  if (!file) return;
  $("working").textContent = `copying ${file.name} ...`;
  const answer = await fetch(`clips?name=${encodeURIComponent(file.name)}`, { method: "POST", body: file });
  const told = await answer.json();
  $("working").textContent = "";
  say(told.error || "");
}

const picture = new Picture($("picture"), page, { change, act, say });

function working(state) {
  const words = [];
  if (state.look?.words) words.push(`${state.look.words} ${Math.round(100 * state.look.share)} %`);
  if (state.make.running) words.push(`making: ${state.make.stage}`);
  return words.join("; ");
}

function render() {
  const state = page.state;
  if (!state) return;
  fill($("clips"), [
    el("option", { value: "", disabled: true, selected: !state.clip }, "choose"),
    ...state.clips.map((name) => el("option", { value: name, selected: state.clip?.name === name }, name)),
  ]);
  if (!$("preset").length) fill($("preset"), state.presets.map((name) => el("option", {}, name)));
  $("working").textContent = working(state);
  $("empty").hidden = !!state.clip;
  $("undo").disabled = !state.undo;
  $("redo").disabled = !state.redo;
  message();
  panels(state, { act, change, page, showTab });
  options();
  strip(state);
  picture.take(state);
  const count = state.look?.times.length ?? 0;
  $("frame").max = Math.max(0, count - 1);
  document.documentElement.dataset.version = state.version;
}

function options() {
  const box = $("options");
  const needed = `${page.tool}`;
  if (box.dataset.of === needed) return;
  box.dataset.of = needed;
  const what = (words) => el("select", { "aria-label": "what is there", onchange: (e) => { page.what = e.target.value; } },
    ...words.map((w) => el("option", { selected: w === page.what }, w)));
  const check = (name, words, title) => el("label", { title },
    el("input", { type: "checkbox", id: name, checked: page[name], onchange: (e) => { page[name] = e.target.checked; } }), ` ${words}`);
  const moves = check("moves", "goes with the flow", "it goes with the flow to the other frames; else it is there in all");
  const begins = check("begins", "from here on", "it is there from this frame on: a level that rises, a front that comes");
  const clear = el("button", { title: "nothing is fluid; then paint what is", onclick: () => picture.clearMask() }, "clear the mask");
  if (page.tool === "brush") {
    fill(box, [what(REGIONS), el("label", {}, "width ",
      el("input", { type: "range", min: 4, max: 120, value: page.width, "aria-label": "width of the brush", oninput: (e) => { page.width = +e.target.value; } })), moves, begins, clear]);
  } else if (page.tool === "area") {
    fill(box, [what(REGIONS), moves, begins, clear, "corner by corner; Enter closes"]);
  } else if (page.tool === "click") {
    if (!["fluid", "not fluid"].includes(page.what)) page.what = "fluid";
    fill(box, [what(["fluid", "not fluid"])]);
  } else if (page.tool === "ruler") {
    fill(box, [el("label", {}, el("input", { type: "number", id: "metres", min: 0.001, step: "any", value: page.metres, oninput: (e) => { page.metres = +e.target.value; } }), " m long; then drag along it")]);
  } else if (page.tool === "horizon") {
    const down = el("input", { type: "number", id: "pitch", min: -90, max: 90, step: "any", placeholder: "90: straight", onchange: (e) => {
      if (e.target.value !== "") change({ set: ["pitch", "horizon"], to: [+e.target.value, null] });
    } });
    fill(box, ["drag its ends; it may lie outside the picture. Or: the camera looks", el("label", {}, down, "° down")]);
  } else if (page.tool === "arrow") {
    fill(box, ["drag the head of an arrow to turn it, its tail to move it; or drag a new one"]);
  } else if (page.tool === "level") {
    fill(box, ["drag along the far edge of still water, or the level in a glass"]);
  } else if (page.tool === "rim") {
    fill(box, ["drag a box around a round, level rim"]);
  } else {
    fill(box, ["this is what was found; a tool puts it right"]);
  }
}

export function choose(tool) {
  page.tool = tool;
  for (const b of document.querySelectorAll("[data-tool]")) b.setAttribute("aria-pressed", b.dataset.tool === tool);
  options();
  picture.changeTool();
}

function showTab(name) {
  for (const b of document.querySelectorAll("[data-tab]")) b.setAttribute("aria-selected", b.dataset.tab === name);
  for (const p of document.querySelectorAll("[data-panel]")) p.hidden = p.dataset.panel !== name;
}

// the strip: thumbnails, and the part that is used between two handles
const trim = { dragging: null, start: 0, end: 1 };

function strip(state) {
  const count = state.strip.count, of = state.clip?.name ?? "", thumbs = $("thumbs");
  if (thumbs.dataset.of !== of || thumbs.children.length > count) { thumbs.dataset.of = of; fill(thumbs, []); }
  for (let k = thumbs.children.length; k < count; k++) thumbs.append(el("img", { src: `strip/${k}.jpg?${encodeURIComponent(of)}`, alt: "" }));
  const duration = state.clip?.duration ?? 0;
  if (!trim.dragging && duration) {
    trim.start = state.hints?.start ?? 0;
    trim.end = Math.min(duration, trim.start + (state.hints?.duration ?? duration));
  }
  placeTrim(duration);
}

function placeTrim(duration) {
  $("strip").style.visibility = duration ? "visible" : "hidden";
  if (!duration) return;
  const a = (100 * trim.start) / duration, b = (100 * trim.end) / duration;
  $("trim-start").style.left = `${a}%`;
  $("trim-end").style.left = `${b}%`;
  $("kept").style.left = `${a}%`;
  $("kept").style.width = `${Math.max(0, b - a)}%`;
  for (const [id, v] of [["trim-start", trim.start], ["trim-end", trim.end]]) {
    $(id).setAttribute("aria-valuenow", v.toFixed(2));
    $(id).setAttribute("aria-valuemin", "0");
    $(id).setAttribute("aria-valuemax", duration.toFixed(2));
  }
}

function sendTrim() {
  const r = (x) => Math.round(1000 * x) / 1000;
  change({ set: ["start", "duration"], to: [r(trim.start), r(trim.end - trim.start)] });
}

function moveTrim(which, time) {
  const duration = page.state.clip.duration, least = Math.min(0.2, duration);
  if (which === "trim-start") trim.start = Math.max(0, Math.min(time, trim.end - least));
  else trim.end = Math.min(duration, Math.max(time, trim.start + least));
  placeTrim(duration);
}

for (const id of ["trim-start", "trim-end"]) {
  const handle = $(id);
  handle.addEventListener("pointerdown", (e) => { handle.setPointerCapture(e.pointerId); trim.dragging = id; });
  handle.addEventListener("pointermove", (e) => {
    if (trim.dragging !== id) return;
    const box = $("strip").getBoundingClientRect();
    moveTrim(id, ((e.clientX - box.left) / box.width) * page.state.clip.duration);
  });
  handle.addEventListener("pointerup", () => { if (trim.dragging === id) { trim.dragging = null; sendTrim(); } });
  handle.addEventListener("keydown", (e) => {
    const step = { ArrowLeft: -0.1, ArrowRight: 0.1 }[e.key];
    if (!step) return;
    e.stopPropagation();
    moveTrim(id, (id === "trim-start" ? trim.start : trim.end) + step);
    sendTrim();
  });
}

$("clips").addEventListener("change", (e) => act("open", { name: e.target.value }));
$("file").addEventListener("change", (e) => { addClip(e.target.files[0]); e.target.value = ""; });
$("undo").addEventListener("click", () => act("undo"));
$("redo").addEventListener("click", () => act("redo"));
$("run").addEventListener("click", () => picture.toggle());
$("frame").addEventListener("input", (e) => picture.show(+e.target.value));
$("make").addEventListener("click", () => act("make", { preset: $("preset").value }));
$("stop").addEventListener("click", () => act("stop"));
for (const b of document.querySelectorAll("[data-tool]")) b.addEventListener("click", () => choose(b.dataset.tool));
for (const b of document.querySelectorAll("[data-tab]")) b.addEventListener("click", () => showTab(b.dataset.tab));
for (const id of ["show-mask", "show-arrows", "show-lines"]) $(id).addEventListener("change", () => picture.draw());

const stage = $("stage");
window.addEventListener("dragstart", (e) => e.preventDefault()); // pictures of the page are drawn on, not carried about
for (const name of ["dragenter", "dragover"]) window.addEventListener(name, (e) => { e.preventDefault(); stage.classList.add("over"); });
window.addEventListener("dragleave", (e) => { if (!e.relatedTarget) stage.classList.remove("over"); });
window.addEventListener("drop", (e) => { e.preventDefault(); stage.classList.remove("over"); addClip(e.dataTransfer.files[0]); });

const KEYS = { v: "look", b: "brush", a: "area", c: "click", h: "horizon", r: "ruler", e: "rim", f: "arrow", l: "level" };
window.addEventListener("keydown", (e) => {
  if (["INPUT", "SELECT", "TEXTAREA"].includes(e.target.tagName) && e.target.type !== "range" && e.target.type !== "checkbox") return;
  const key = e.key.toLowerCase();
  if ((e.ctrlKey || e.metaKey) && key === "z") { e.preventDefault(); act(e.shiftKey ? "redo" : "undo"); return; }
  if (e.ctrlKey || e.metaKey || e.altKey) return;
  if (key === " " && e.target.tagName !== "BUTTON") { e.preventDefault(); picture.toggle(); }
  else if (key === "arrowleft" && e.target.id !== "frame") picture.show(picture.number - 1);
  else if (key === "arrowright" && e.target.id !== "frame") picture.show(picture.number + 1);
  else if (key === "enter") picture.finish();
  else if (key === "escape") { picture.cancel(); say(""); }
  else if (KEYS[key]) choose(KEYS[key]);
});

// where tests and the curious find the picture and its tools
window.studio = { get size() { return picture.size; }, get tool() { return page.tool; }, handles: () => picture.handles(), change, drawn: () => picture.drawn() };
picture.told = (number, time, running) => {
  $("frame").value = number;
  $("time").textContent = time === null ? "" : `${time.toFixed(2)} s`;
  $("run").textContent = running ? "Pause" : "Play";
};

choose("look");
const events = new EventSource("events");
events.onmessage = (e) => { page.state = JSON.parse(e.data); render(); };
events.onerror = () => { $("working").textContent = "the studio does not answer; what you did is on disk, start it again"; };
