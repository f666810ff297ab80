// State, controls, and the address: #layer=primary&show=error&pixel=12,7&theme=dark opens the page like that.

const SHOWN = { value: "value", error: "standard error", ratio: "value ÷ error" };
const CHANNELS = { mean: "mean", 0: "R", 1: "G", 2: "B" };
const RATIO_LIMIT = 6;  // standard errors: beyond, nobody doubts
const NEAR = 0.03;      // of the width of a pane, from the divider
const state = { view: 0, layer: "", show: "value", channel: "mean", zoomed: 0, left: "", right: "", split: 0.5, exposure: 0, pixel: null, pinned: false, limit: 1, chips: 1 };
const wanted = new URLSearchParams(location.hash.slice(1));
const images = {};  // canvases of the film's size, by pane
let views = [];

const view = () => views[state.view];
const named = (name) => view().layers.find((layer) => layer.name === name);
const layersOf = (role) => view().layers.filter((layer) => layer.role === role);

function segments(id, choices, chosen, choose) {
  element(id).replaceChildren(...Object.entries(choices).map(([key, text]) => {
    const button = cell("button", text, { key });
    button.type = "button";
    button.setAttribute("role", "tab");
    button.setAttribute("aria-selected", String(key === String(chosen)));
    button.addEventListener("click", () => choose(key));
    return button;
  }));
}

function choices(id, names, chosen, choose) {
  const select = element(id);
  select.replaceChildren(...names.map((name) => {
    const option = cell("option", name);
    option.selected = name === chosen;
    return option;
  }));
  select.onchange = () => choose(select.value);
}

// The plane that the right pane shows, on which kind of scale, and the end of that scale for all layers.
function chosenPlane() {
  const layer = named(state.layer);
  const pick = (planes, average) => (state.channel === "mean" || !planes[state.channel] ? average : planes[state.channel]);
  const value = pick(layer.value, layer.mean);
  const error = layer.stderr && pick(layer.stderr, layer.meanStderr);
  if (state.show === "error" && error) return { plane: error, kind: "size" };
  if (state.show === "ratio" && error) return { plane: value.map((x, i) => (x === 0 ? 0 : x / error[i])), kind: "signed" };
  return { plane: value, kind: "signed" };
}

// One scale for all layers of a kind, so that terms can be compared.
function commonLimit() {
  const own = view();
  own.limits = own.limits || {};
  if (state.show === "ratio") return RATIO_LIMIT;
  const which = state.show === "error" ? "meanStderr" : "mean";
  own.limits[which] = own.limits[which] || robustLimit(layersOf("signed").map((layer) => layer[which]).filter(Boolean));
  return own.limits[which];
}

function paintSigned() {
  if (!state.layer) return;
  const { plane, kind } = chosenPlane();
  state.limit = commonLimit() * 10 ** state.zoomed;
  state.chips = kind === "signed" && state.show === "value" ? state.limit : view().limits.mean || state.chips;
  images.signed = [signedCanvas(view(), plane, kind, state.limit)];
  const beyond = plane.reduce((count, x) => count + (Math.abs(x) > state.limit), 0) / plane.length;
  drawScale(kind, state.limit, state.show === "ratio" ? "standard errors" : view().unit, beyond);
}

function paintRadiance() {
  const shown = state.left === state.right ? [state.left] : [state.left, state.right];
  images.radiance = shown.filter(Boolean).map((name) => radianceCanvas(view(), named(name), state.exposure));
}

function redraw() {
  for (const pane of PANES) if (images[pane] && images[pane].length) show(pane, view(), images[pane], state.split, state.pixel);
  if (state.pixel) readout(view(), state.pixel, state, (name) => change({ layer: name }));
}

function change(news) {
  Object.assign(state, news);
  controls();
  if ("exposure" in news || "left" in news || "right" in news || "view" in news) paintRadiance();
  if (["layer", "show", "channel", "zoomed", "view"].some((key) => key in news)) paintSigned();
  redraw();
}

function controls() {
  const signed = layersOf("signed"), seen = layersOf("radiance");
  element("signed").hidden = !signed.length;
  element("radiance").hidden = !seen.length;
  segments("views", views.length > 1 ? Object.fromEntries(views.map((v, k) => [k, v.name])) : {}, state.view, (k) => openView(Number(k)));
  segments("layers", Object.fromEntries(signed.map((layer) => [layer.name, layer.name])), state.layer, (name) => change({ layer: name }));
  for (const button of element("layers").children) {
    const empty = named(button.dataset.key).mean.every((x) => x === 0);
    button.classList.toggle("zero", empty);
    if (empty) button.title = "0 everywhere";
  }
  const known = signed.some((layer) => layer.stderr);
  segments("show", known ? SHOWN : {}, state.show, (key) => change({ show: key, zoomed: 0 }));
  const coloured = signed.some((layer) => layer.value.length === 3);
  segments("channel", coloured ? CHANNELS : {}, state.channel, (key) => change({ channel: key }));
  const several = seen.length > 1;
  for (const id of ["left", "right", "split-label"]) element(id).hidden = !several;
  element("radiance-name").hidden = several;
  if (seen.length) element("radiance-name").textContent = seen[0].name;
  choices("left", seen.map((layer) => layer.name), state.left, (name) => change({ left: name }));
  choices("right", seen.map((layer) => layer.name), state.right, (name) => change({ right: name }));
  element("split").value = 1000 * state.split;
  element("exposure").value = state.exposure;
  element("stops").textContent = `${state.exposure > 0 ? "+" : ""}${state.exposure} EV`.replace("-", "−");
  element("limit").value = state.zoomed;
}

function openView(k) {
  state.view = k;
  const signed = layersOf("signed"), seen = layersOf("radiance");
  const pick = (name, found, otherwise) => (found.some((layer) => layer.name === name) ? name : otherwise);
  const brightest = signed.find((layer) => layer.name === "total") || signed[0];
  state.layer = pick(state.layer, signed, brightest ? brightest.name : "");
  state.left = pick(state.left, seen, seen.length ? seen[0].name : "");
  state.right = pick(state.right, seen, seen.length > 1 ? seen[1].name : state.left);
  const { width, height } = view();
  if (!state.pixel || state.pixel.x >= width || state.pixel.y >= height) state.pixel = { x: width >> 1, y: height >> 1 };
  change({ view: k });
}

function useTheme(name) {
  document.documentElement.dataset.theme = name;
  inkCurves();
  if (views.length) change({ layer: state.layer });
}

function header() {
  element("title").textContent = data.title;
  element("about").textContent = data.about;
  element("facts").replaceChildren(...data.facts.map(([key, text]) => {
    const fact = document.createElement("div");
    fact.append(cell("dt", key), cell("dd", text));
    return fact;
  }));
  if (data.views.length) element("stored").textContent = `Values are stored to ±${(100 * data.precision).toPrecision(1)} % of themselves, or of 1/64 of the colour scale where they are smaller. Errors of the mean of channels are upper bounds.`;
}

function ears() {
  const actions = {
    view, redraw,
    hover: (pixel) => { if (pixel && !state.pinned) { state.pixel = pixel; redraw(); } },
    pin: (pixel) => { if (pixel) { const same = state.pinned && pixel.x === state.pixel.x && pixel.y === state.pixel.y; Object.assign(state, { pixel, pinned: !same }); redraw(); } },
    step: (dx, dy) => {
      const { width, height } = view();
      state.pixel = { x: Math.min(width - 1, Math.max(0, state.pixel.x + dx)), y: Math.min(height - 1, Math.max(0, state.pixel.y + dy)) };
      state.pinned = true;
      redraw();
    },
    nearSplit: (x) => images.radiance.length > 1 && Math.abs(x - state.split) < NEAR,
    split: (x) => change({ split: Math.min(1, Math.max(0, x)) }),
  };
  for (const pane of PANES) listen(pane, actions);
  element("split").addEventListener("input", (event) => change({ split: event.target.value / 1000 }));
  element("exposure").addEventListener("input", (event) => change({ exposure: Number(event.target.value) }));
  element("limit").addEventListener("input", (event) => change({ zoomed: Number(event.target.value) }));
  element("theme").addEventListener("click", () => useTheme(theme() === "dark" ? "light" : "dark"));
  new ResizeObserver(redraw).observe(element("panes"));
}

async function start() {
  useTheme(wanted.get("theme") || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light"));
  header();
  buildCurves();
  views = await decodeAll();
  element("panes").hidden = element("readout").hidden = !views.length;
  if (views.length) {
    for (const key of ["layer", "show", "channel", "left", "right"]) if (wanted.has(key)) state[key] = wanted.get(key);
    if (wanted.has("split")) state.split = Number(wanted.get("split"));
    if (wanted.has("pixel")) {
      const [x, y] = wanted.get("pixel").split(",").map(Number);
      Object.assign(state, { pixel: { x, y }, pinned: true });
    }
    openView(Math.min(views.length - 1, Number(wanted.get("view") || 0)));
    ears();
  }
  document.body.dataset.ready = "yes";
}

start().catch((error) => {
  element("failure").hidden = false;
  element("failure").textContent = `This page cannot be shown: ${error.message}. It needs a browser of 2023 or newer.`;
  document.body.dataset.ready = "failed";
});
