// What stands beside the picture: what was found, what was said, how making goes, and the shelf.
export function el(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (typeof value === "boolean") made[name] = value;
    else made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

export function fill(parent, children) { parent.replaceChildren(...children); }

const $ = (id) => document.getElementById(id);
const KINDS = ["stream", "fall", "pour", "plume", "dam", "basin", "fountain"];
const PICTURED = new Set(["read", "flow", "segment", "correct", "geometry", "motion"]);
const shown = new Map();

// a panel is made anew only when what it shows has changed, so that no click falls into a change
function panel(id, facts, make) {
  const text = JSON.stringify(facts);
  if (shown.get(id) === text) return;
  shown.set(id, text);
  fill($(id), make());
}

const warning = (text) => el("p", { class: "warning" }, text);

export function panels(state, doing) {
  const look = state.look, facts = look?.facts, hints = state.hints ?? {};
  panel("found", [state.clip?.name, facts, look?.so_far, look?.warnings, hints.kind, hints.pitch, hints.horizon, hints.level, hints.ruler], () => found(state, doing));
  panel("said", [state.clip?.name, hints, state.broken], () => said(state, doing));
  panel("about", [state.clip, look?.read_warnings], () => about(state));
  making(state, doing);
  panel("shelf", [state.shelf, state.make.running], () => shelf(state, doing));
  panel("trash", [state.trash], () => trash(state, doing));
}

// what a look has told so far stands beside what the last whole one found
function found(state, { change }) {
  const facts = state.look?.facts, known = { ...facts, ...state.look?.so_far }, hints = state.hints ?? {};
  if (!state.clip) return [el("p", { class: "soft" }, "No clip is open.")];
  const scores = facts ? Object.entries(facts.probability) : [];
  const chosen = el("select", { id: "kind", "aria-label": "kind", onchange: (e) => change({ set: "kind", to: e.target.value || null }) },
    el("option", { value: "", selected: !hints.kind }, facts && !hints.kind ? `as found: ${facts.kind}` : "as found"),
    ...KINDS.map((k) => el("option", { value: k, selected: hints.kind === k }, k)));
  const rows = [["Kind", chosen]];
  for (const [name, share] of scores.slice(0, 3)) {
    const bar = el("span", { class: "bar" });
    bar.style.width = `${Math.round(120 * share)}px`;
    rows.push(["", el("span", {}, bar, `${name} ${share.toFixed(2)}`)]);
  }
  if (facts) {
    const error = hints.horizon || hints.pitch !== undefined ? "as said" : `± ${facts.pitch_error.toFixed(0)}°, from ${facts.tilt_from}`;
    rows.push(["Tilt", `looks ${facts.pitch.toFixed(0)}° down (${error})`]);
    rows.push(["Scale", facts.scale.replace(/^scale: /, "")]);
  }
  if (known.fluid_share !== undefined) rows.push(["Fluid", `${Math.round(100 * known.fluid_share)} % of the picture, sure ${known.fluid_sure.toFixed(2)}`]);
  const parts = (facts?.parts ?? []).slice(1);
  parts.forEach((part, k) => rows.push([k ? "" : "Parts", `${part.is} ${part.probability.toFixed(2)}`]));
  if (facts?.level_probability !== undefined) {
    const level = facts.level_probability.toFixed(2);
    rows.push(["Slope", facts.slope >= 1 ? `falls by ${facts.slope.toFixed(0)}° (level: ${level})` : `level (${level})`]);
  }
  if (known.camera) rows.push(["Camera", known.camera.words.replace(/^the camera /, "")]);
  if (facts) rows.push(["Lens", `${facts.field_of_view.toFixed(0)}° across`]);
  const told = (state.look?.warnings ?? []).map(warning);
  return [el("table", {}, ...rows.map(([a, b]) => el("tr", {}, el("th", {}, a), el("td", {}, b)))), ...told];
}

function said(state, { change, act }) {
  if (state.broken) {
    return [warning(`${state.broken} cannot be used.`), el("button", { id: "fresh", onclick: () => act("fresh") }, "Move it aside and begin anew")];
  }
  const hints = state.hints ?? {}, items = [];
  const item = (text, step) => items.push(el("li", {}, el("span", {}, text), el("button", { title: "take it back", "aria-label": `take back: ${text}`, onclick: () => change(step) }, "×")));
  if (hints.start !== undefined || hints.duration !== undefined) item(`used: ${(hints.start ?? 0).toFixed(2)} s, ${(hints.duration ?? 0).toFixed(2)} s long`, { set: ["start", "duration"], to: [null, null] });
  if (hints.kind) item(`kind: ${hints.kind}`, { set: "kind", to: null });
  if (hints.fov) item(`field of view: ${hints.fov}°`, { set: "fov", to: null });
  if (hints.pitch !== undefined) item(`looks ${hints.pitch}° down`, { set: "pitch", to: null });
  if (hints.horizon) item("a horizon", { set: "horizon", to: null });
  if (hints.level) item("a level line", { set: "level", to: null });
  if (hints.ruler) item(`a ruler of ${hints.ruler.metres} m`, { set: "ruler", to: null });
  if (hints.roi) item("fluid only inside a box", { set: "roi", to: null });
  (hints.rims ?? []).forEach((r, k) => item(`rim ${k + 1}`, { remove: "rims", at: k }));
  (hints.regions ?? []).forEach((r, k) => item(`${r.is}: ${r.area ? "area" : "brush"} ${k + 1}${r.moves ? `, from ${(r.time ?? 0).toFixed(2)} s with the flow` : ""}${r.from === undefined ? "" : `, from ${r.from.toFixed(2)} s on`}`, { remove: "regions", at: k }));
  (hints.flow ?? []).forEach((a, k) => item(`arrow ${k + 1} of the flow`, { remove: "flow", at: k }));
  (hints.clicks ?? []).forEach((c, k) => item(`click ${k + 1}: ${c.fluid ? "fluid" : "not fluid"}`, { remove: "clicks", at: k }));
  if (!items.length) return [el("p", { class: "soft" }, state.clip ? "Nothing yet. Choose a tool above the picture." : "")];
  return [el("ul", { class: "said" }, ...items), el("p", { class: "soft" }, `on disk: ${state.hints_file}`)];
}

function about(state) {
  const clip = state.clip;
  if (!clip?.size) return [];
  const lines = [el("p", {}, `${clip.size[0]} × ${clip.size[1]} px, ${clip.frame_count} frames, ${clip.fps.toFixed(1)} per second, ${clip.duration.toFixed(1)} s`)];
  const warnings = [...new Set([...(clip.warnings ?? []), ...(state.look?.read_warnings ?? [])])];
  return [...lines, ...(warnings.length ? warnings.map(warning) : [el("p", { class: "soft" }, "Nothing to warn of.")])];
}

function making(state, doing) {
  const make = state.make;
  $("make").disabled = make.running || !state.hints;
  $("stop").disabled = !make.running;
  panel("will", [state.clip?.asset], () => (state.clip?.asset ? [`makes ${state.clip.asset} in ${state.folder}`] : []));
  panel("stages", [make.finished, make.stage, Math.round(20 * make.share), make.running], () => [
    ...make.finished.map((s) => {
      const line = el("li", {}, `${s.name}: ${s.kept ? "kept from before" : `${s.seconds} s`}`);
      if (PICTURED.has(s.name)) line.append(el("img", { src: `stages/${s.name}.jpg?${make.asset}${s.seconds}`, alt: `after ${s.name}` }));
      return line;
    }),
    ...(make.running ? [el("li", {}, `${make.stage} ${Math.round(100 * make.share)} % (${make.number} of ${make.count})`)] : []),
  ]);
  panel("outcome", [make.outcome, make.failed], () => (make.outcome ? [make.failed ? warning(make.outcome) : make.outcome] : []));
  const entry = state.shelf.find((e) => e.name === (make.asset || state.clip?.asset));
  panel("result", [entry, make.running], () => (entry && !make.running ? [card(entry, doing), el("button", { id: "back", onclick: () => doing.showTab("clip") }, "Back to the hints")] : []));
}

const size = (bytes) => (bytes > 1e9 ? `${(bytes / 1e9).toFixed(1)} GB` : `${(bytes / 1e6).toFixed(0)} MB`);

async function view(name, act) {
  const opened = window.open("about:blank");
  const told = await act("view", { name });
  if (told.done && opened) opened.location = told.done;
  else opened?.close();
}

function card(entry, { act }) {
  const rows = entry.card.map((r) => el("tr", {}, ...r.slice(0, 4).map((x) => el("td", {}, x))));
  return el("div", { class: "card" },
    el("img", { src: `shelf/${encodeURIComponent(entry.name)}/picture.jpg?${entry.changed}`, alt: `${entry.name}, simulated` }),
    el("p", {}, el("strong", {}, entry.name), ` ${size(entry.bytes)}`),
    el("p", { class: "soft" }, entry.verdict), el("table", {}, ...rows),
    el("div", { class: "row" }, el("button", { class: "main", onclick: () => view(entry.name, act) }, "Open in the viewer")));
}

function shelf(state, doing) {
  const { act } = doing;
  if (!state.shelf.length) return [el("p", { class: "soft" }, `No assets in ${state.folder} yet.`)];
  return state.shelf.map((entry) => {
    const made = card({ ...entry, card: [] }, doing), busy = state.make.running;
    made.lastChild.append(
      el("button", { disabled: busy, onclick: () => act("duplicate", { name: entry.name }) }, "Duplicate"),
      el("button", { onclick: async (e) => {
        e.target.disabled = true;
        const told = await act("export", { name: entry.name });
        e.target.disabled = false;
        if (told.done) made.append(el("p", { class: "soft" }, `written: ${told.done}, a page that plays offline`));
      } }, "Export a page"),
      el("button", { disabled: busy, onclick: () => act("discard", { name: entry.name }) }, "To the trash"));
    return made;
  });
}

function trash(state, { act }) {
  if (!state.trash.length) return [];
  return [el("h2", {}, "Trash"), el("ul", { class: "said" }, ...state.trash.map((name) =>
    el("li", {}, el("span", {}, name), el("button", { onclick: () => act("restore", { name }) }, "Restore"))))];
}
