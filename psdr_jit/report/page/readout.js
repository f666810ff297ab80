// The table of all layers at one pixel.

function cell(tag, text, data = {}) {
  const made = document.createElement(tag);
  made.textContent = text;
  Object.assign(made.dataset, data);
  return made;
}

function valueCell(layer, channel, planes, errors, at) {
  const made = document.createElement("td");
  const value = planes[at];
  Object.assign(made.dataset, { layer: layer.name, channel, value });
  made.append(number(value));
  if (errors) {
    made.dataset.stderr = errors[at];
    const error = document.createElement("span");
    error.className = "pm";
    error.textContent = ` ± ${number(errors[at], 2)}`;
    made.append(error);
  }
  return made;
}

function chip(layer, at, limit) {
  const made = document.createElement("span");
  made.className = "chip";
  const rgb = layer.role === "signed" ? colour(layer.mean[at], "signed", limit)
    : [0, 1, 2].map((c) => srgb((layer.value[c] || layer.value[0])[at]));
  made.style.background = `rgb(${rgb.map(Math.round).join(",")})`;
  return made;
}

function row(layer, at, state, choose) {
  const made = document.createElement("tr");
  const head = cell("td", "");
  head.append(chip(layer, at, state.chips), layer.name);
  made.append(head);
  layer.value.forEach((plane, c) => made.append(valueCell(layer, c, plane, layer.stderr && layer.stderr[c], at)));
  if (layer.value.length > 1) made.append(valueCell(layer, "mean", layer.mean, layer.meanStderr, at));
  if (layer.role === "signed") {
    made.className = layer.name === state.layer ? "choice chosen" : "choice";
    made.addEventListener("click", () => choose(layer.name));
  }
  return made;
}

function readout(view, pixel, state, choose) {
  const channels = Math.max(...view.layers.map((layer) => layer.value.length));
  const names = channels === 3 ? ["R", "G", "B"] : channels === 1 ? ["value"] : [...Array(channels).keys()].map(String);
  const head = document.createElement("tr");
  for (const name of ["layer", ...names, ...(channels > 1 ? ["mean"] : [])]) head.append(cell("th", name));
  const table = element("readout");
  table.querySelector("thead").replaceChildren(head);
  element("pixel").textContent = `pixel (${pixel.x}, ${pixel.y})`;
  element("hint").textContent = state.pinned ? "pinned; arrow keys move it, a click elsewhere pins that pixel"
    : "click to pin, wheel to zoom, double click for all of it";
  const at = pixel.y * view.width + pixel.x;
  table.querySelector("tbody").replaceChildren(...view.layers.map((layer) => row(layer, at, state, choose)));
}
