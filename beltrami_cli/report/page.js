"use strict";

// What the keys do, on every page.

const byId = (id) => document.getElementById(id);
const actions = {};

function say(text) {
  const said = byId("said");
  if (said) said.textContent = text;
}

document.addEventListener("keydown", (event) => {
  const typing = event.target.closest("input, textarea, dialog");
  if (typing || event.ctrlKey || event.metaKey || event.altKey) return;
  const selecting = event.target.closest("select") && event.key.length === 1 && event.key !== "c";
  const action = actions[event.key];
  if (!action || selecting) return;
  event.preventDefault();
  action();
});

document.addEventListener("click", (event) => {
  const button = event.target.closest("button[data-key]");
  if (button) actions[button.dataset.key]();
});

// Channels: the drawings of one at a time.

const channelSelect = byId("channel");
let channel = 0;
let onChannel = () => {};

function showChannel(k) {
  channel = k;
  channelSelect.value = k;
  for (const section of document.querySelectorAll("[data-channel]")) section.hidden = Number(section.dataset.channel) !== k;
  onChannel();
  say(`Channel ${k + 1}`);
}

if (channelSelect) {
  channelSelect.addEventListener("change", () => showChannel(Number(channelSelect.value)));
  actions.c = () => showChannel((channel + 1) % channelSelect.options.length);
  showChannel(0);
}

// The surface in 3-D.

const HALF_ANGLE = Math.tan(Math.PI / 8); // plotly's perspective opens by 45 degrees

if (byId("scene")) drawSurface(JSON.parse(byId("scene").textContent));

function drawSurface(scene) {
  const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  const triangles = new Uint32Array(bytes(scene.triangles));
  const sulcus = scene.sulcus && new Uint8Array(bytes(scene.sulcus));
  const table = new Uint8Array(bytes(scene.colours));
  const colours = Array.from({ length: 256 }, (_, k) => [0, 1, 2].map((c) => table[3 * k + c] / 255));
  const css = (k) => `rgb(${table.slice(3 * k, 3 * k + 3).join(" ")})`;
  const maps = scene.maps.map((map) => ({
    title: map.title,
    values: map.values.map((text) => new Float32Array(bytes(text))),
    filled: map.filled && new Uint8Array(bytes(map.filled)),
  }));
  const forms = scene.forms.map((form) => ({ name: form.name, ...placed(form), borders: borderLines(form) }));
  const best = facing(scene.best.camera);
  const shown = { i: true, f: true, m: true };
  const panes = [];
  let camera = best();
  let turn = 0; // by how many places the maps are swapped round

  function placed(form) {
    const steps = new Uint16Array(bytes(form.positions));
    const axes = [0, 1, 2].map((axis) => Float64Array.from({ length: steps.length / 3 }, (_, v) => steps[3 * v + axis] / 65535 - form.half[axis]));
    return { x: axes[0], y: axes[1], z: axes[2] };
  }

  function borderLines(form) {
    const ends = new Float32Array(bytes(form.borders));
    const lines = { x: [], y: [], z: [] };
    for (let s = 0; s < ends.length; s += 6) {
      for (const [axis, name] of ["x", "y", "z"].entries()) lines[name].push(ends[s + axis], ends[s + 3 + axis], null);
    }
    return lines;
  }

  // A camera from a side, as near as every surface fits into its pane; made when asked, because panes change in size.
  function facing([right, up, towards]) {
    return () => {
      // Letters at the sides take room.
      const [wide, tall] = panes.map(({ plot }) => [(plot.clientWidth - 60) / plot.clientHeight, 1 - 44 / plot.clientHeight])
        .find(([share]) => share > 0) || [1, 1];
      let distance = 0;
      for (const form of forms) {
        for (let v = 0; v < form.x.length; v++) {
          const along = (way) => way[0] * form.x[v] + way[1] * form.y[v] + way[2] * form.z[v];
          const reach = Math.max(Math.abs(along(up)) / tall, Math.abs(along(right)) / wide) / HALF_ANGLE;
          distance = Math.max(distance, along(towards) + reach);
        }
      }
      return { eye: towards.map((part) => part * distance), up, centre: [0, 0, 0] };
    };
  }

  function forPlotly({ eye, up, centre }) {
    const point = ([x, y, z]) => ({ x, y, z });
    const at = eye.map((part, k) => part + centre[k]);
    return { eye: point(at), up: point(up), center: point(centre), projection: { type: "perspective" } };
  }

  const pale = colours.map((colour) => colour.map((part, c) => scene.fading * scene.greys[0][c] + (1 - scene.fading) * part));

  // One colour per vertex: a scale that wraps must not be interpolated as a number.
  function vertexColours(map) {
    const { low, high, cyclic } = scene.scales[channel] || { low: 0, high: 1 }; // without one there is no value
    return Array.from(map.values[channel], (value, v) => {
      let share = (value - low) / (high - low);
      share = cyclic ? share - Math.floor(share) : Math.min(Math.max(share, 0), 1);
      const from = map.filled && map.filled[v] ? pale : colours;
      return from[Math.min(Math.floor(share * 256), 255)] || scene.greys[0];
    });
  }

  function traces(form, map) {
    const values = map.values[channel];
    const known = { i: [], j: [], k: [] };
    const missing = { i: [], j: [], k: [] };
    for (let t = 0; t < triangles.length; t += 3) {
      const [a, b, c] = [triangles[t], triangles[t + 1], triangles[t + 2]];
      const kind = Number.isFinite(values[a] + values[b] + values[c]) ? known : missing;
      kind.i.push(a);
      kind.j.push(b);
      kind.k.push(c);
    }
    const common = {
      type: "mesh3d", x: form.x, y: form.y, z: form.z,
      // A light at the camera: in plotly.js its place is given in the picture's own frame, where 1 lies far behind the eye.
      lightposition: { x: 0, y: 0, z: 1.0003 },
      lighting: { ambient: 0.55, diffuse: 0.5, specular: 0, roughness: 1, fresnel: 0, vertexnormalsepsilon: 0, facenormalsepsilon: 0 },
    };
    // Only where no folds are to be seen do greys have to tell of them.
    const isDark = (v) => sulcus && form.name === "inflated" && sulcus[v];
    const greys = Array.from(form.x, (_, v) => scene.greys[isDark(v) ? 1 : 0]);
    return [
      { ...common, ...known, vertexcolor: vertexColours(map), visible: known.i.length > 0 },
      { ...common, ...missing, vertexcolor: greys, visible: missing.i.length > 0 && shown.m },
      {
        type: "scatter3d", mode: "lines", ...form.borders, connectgaps: false,
        line: { color: scene.outline, width: 4 }, visible: form.borders.x.length > 0 && shown.f,
      },
    ];
  }

  function layout() {
    const axis = { visible: false, range: [-0.51, 0.51], showspikes: false };
    return {
      margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, paper_bgcolor: "rgba(0,0,0,0)", hovermode: false,
      scene: { xaxis: { ...axis }, yaxis: { ...axis }, zaxis: { ...axis }, aspectmode: "manual", aspectratio: { x: 1, y: 1, z: 1 }, dragmode: false, camera: forPlotly(camera) },
    };
  }

  const options = { displayModeBar: false, responsive: true, scrollZoom: false };

  function makePanes() {
    for (const form of forms) {
      const row = byId("panes").appendChild(document.createElement("div"));
      row.className = "row";
      row.dataset.maps = maps.length;
      for (const [m, map] of maps.entries()) {
        const figure = row.appendChild(document.createElement("figure"));
        figure.className = "pane";
        figure.tabIndex = 0;
        figure.setAttribute("aria-label", `${map.title}, ${form.name}, in 3-D; arrow keys turn it`);
        const caption = figure.appendChild(document.createElement("figcaption"));
        caption.textContent = map.title;
        if (forms.length > 1) caption.appendChild(document.createElement("span")).textContent = ` ${form.name}`;
        const stage = figure.appendChild(document.createElement("div"));
        stage.className = "stage";
        const plot = stage.appendChild(document.createElement("div"));
        plot.className = "plot";
        const letters = ["left", "right", "bottom", "top"].map((side) => {
          const letter = stage.appendChild(document.createElement("span"));
          letter.className = `letter ${side}`;
          letter.setAttribute("aria-hidden", "true");
          return letter;
        });
        panes.push({ form, map, m, row, figure, plot, letters });
      }
    }
  }

  // One camera for all panes: eye from the centre it looks at, in the box whose longest edge is 1.

  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const unit = (a) => a.map((part) => part / Math.hypot(...a));
  const sum = (a, b, share) => a.map((part, k) => part + share * b[k]);
  let isWaiting = false;

  // view: the name of the side from which the camera looks.
  function look(next, view = null) {
    camera = next;
    if (view !== null) tellView(view);
    letter();
    byId("tip").hidden = true;
    if (isWaiting) return;
    isWaiting = true;
    requestAnimationFrame(() => {
      isWaiting = false;
      for (const pane of panes) if (!pane.row.hidden) Plotly.relayout(pane.plot, { "scene.camera": forPlotly(camera) });
    });
  }

  function tellView(name) {
    byId("view").textContent = `Seen: ${name}`;
    for (const [k, view] of scene.views.entries()) toggle(k + 1).setAttribute("aria-current", view.name === name);
  }

  // Where left, right, posterior, anterior, inferior and superior are: of an oblique side its main parts, the first most.
  function letter() {
    const { right, up } = sides();
    const names = [right.map((part) => -part), right, up.map((part) => -part), up].map((way) =>
      [0, 1, 2].filter((axis) => Math.abs(way[axis]) > 0.4).sort((a, b) => Math.abs(way[b]) - Math.abs(way[a]))
        .map((axis) => ["LR", "PA", "IS"][axis][way[axis] > 0 ? 1 : 0]).join(""));
    for (const pane of panes) for (const [k, name] of names.entries()) pane.letters[k].textContent = name;
  }

  function sides() {
    const towards = unit(camera.eye);
    const right = unit(cross(camera.up, towards));
    return { towards, right, up: cross(towards, right) };
  }

  // The eye goes round the surface by angles (radians) to the right and up.
  function rotate(across, upwards) {
    const { towards, right, up } = sides();
    const size = Math.hypot(...camera.eye);
    const aside = sum(towards.map((part) => part * Math.cos(across)), right, Math.sin(across));
    const eye = sum(aside.map((part) => part * Math.cos(upwards)), up, Math.sin(upwards));
    look({ ...camera, eye: eye.map((part) => part * size), up: sum(up.map((part) => part * Math.cos(upwards)), aside, -Math.sin(upwards)) }, "turned");
  }

  // By shares of the pane's height.
  function move(across, upwards) {
    const { right, up } = sides();
    const height = 2 * HALF_ANGLE * Math.hypot(...camera.eye);
    look({ ...camera, centre: sum(sum(camera.centre, right, across * height), up, upwards * height) });
  }

  function zoom(factor) {
    const size = Math.hypot(...camera.eye);
    look({ ...camera, eye: camera.eye.map((part) => (part / size) * Math.min(Math.max(size * factor, 0.1), 20)) });
  }

  function listen(pane) {
    const { figure, plot } = pane;
    const isUsed = () => figure.contains(document.activeElement);
    plot.addEventListener("pointerdown", (event) => {
      figure.focus({ preventScroll: true });
      plot.setPointerCapture(event.pointerId);
      event.preventDefault();
    });
    plot.addEventListener("pointermove", (event) => {
      if (!event.buttons) return point(event, pane);
      const [across, upwards] = [event.movementX, event.movementY].map((pixels) => pixels / plot.clientHeight);
      if (event.buttons & 1 && !event.shiftKey) return rotate(-Math.PI * across, Math.PI * upwards);
      return move(-across, upwards);
    });
    plot.addEventListener("wheel", (event) => {
      if (!isUsed() && !event.ctrlKey) return; // the page scrolls
      event.preventDefault();
      zoom(Math.exp(0.0015 * Math.min(Math.max(event.deltaY, -200), 200)));
    }, { passive: false });
    plot.addEventListener("contextmenu", (event) => event.preventDefault());
    plot.addEventListener("pointerleave", () => { byId("tip").hidden = true; });
    figure.addEventListener("keydown", (event) => {
      const step = Math.PI / 18;
      const keys = {
        ArrowLeft: () => rotate(-step, 0), ArrowRight: () => rotate(step, 0), ArrowUp: () => rotate(0, step), ArrowDown: () => rotate(0, -step),
        "+": () => zoom(0.9), "=": () => zoom(0.9), "-": () => zoom(1 / 0.9),
      };
      if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
      event.preventDefault();
      keys[event.key]();
    });
  }

  // What the pointer is over: the nearest corner of the first triangle that the line of sight meets.

  function cornerUnder(event, { form, plot, map }) {
    const box = plot.getBoundingClientRect();
    const { towards, right, up } = sides();
    const reach = (2 * HALF_ANGLE) / box.height;
    const toRight = reach * (event.clientX - box.left - box.width / 2);
    const upwards = reach * (box.top + box.height / 2 - event.clientY);
    const ray = sum(sum(towards.map((part) => -part), right, toRight), up, upwards);
    const eye = sum(camera.eye, camera.centre, 1);
    const corner = (v) => [form.x[v] - eye[0], form.y[v] - eye[1], form.z[v] - eye[2]];
    const values = map.values[channel];
    let [nearest, found] = [Infinity, null];
    for (let t = 0; t < triangles.length; t += 3) {
      const ends = [triangles[t], triangles[t + 1], triangles[t + 2]];
      if (!shown.m && !ends.every((v) => Number.isFinite(values[v]))) continue;
      const [a, b, c] = ends.map(corner);
      // Volumes of the three tetrahedra between the ray and the edges: of one sign where it passes inside.
      const shares = [dot(ray, cross(b, c)), dot(ray, cross(c, a)), dot(ray, cross(a, b))];
      if (!(shares.every((share) => share >= 0) || shares.every((share) => share <= 0))) continue;
      const all = shares[0] + shares[1] + shares[2];
      const away = [0, 1, 2].reduce((far, k) => far - (shares[k] / all) * dot(ends.map(corner)[k], towards), 0);
      if (!(away > 0 && away < nearest)) continue;
      nearest = away;
      found = ends[shares.map(Math.abs).reduce((most, share, k, each) => (share > Math.abs(each[most]) ? k : most), 0)];
    }
    return found;
  }

  let pointed = null;

  function point(event, pane) {
    if (pointed === null) requestAnimationFrame(() => {
      const [last, at] = pointed;
      pointed = null;
      showTip(last, cornerUnder(last, at));
    });
    pointed = [event, pane];
  }

  function showTip(event, vertex) {
    const tip = byId("tip");
    tip.hidden = vertex === null;
    if (vertex === null) return;
    tip.replaceChildren(...maps.map((map) => {
      const line = document.createElement("div");
      line.appendChild(document.createElement("b")).textContent = `${map.title} `;
      line.append(told(map, vertex));
      return line;
    }));
    tip.style.left = `${Math.min(event.clientX + 16, innerWidth - tip.offsetWidth - 8)}px`;
    tip.style.top = `${Math.min(event.clientY + 16, innerHeight - tip.offsetHeight - 8)}px`;
  }

  function told(map, vertex) {
    const value = map.values[channel][vertex];
    if (!Number.isFinite(value)) return "missing";
    const { low, high } = scene.scales[channel];
    return toStep(value, (high - low) / 200) + scene.unit + (map.filled && map.filled[vertex] ? " (filled)" : "");
  }

  // As many decimals as tell steps of this size apart.
  function toStep(value, step) {
    return value.toFixed(Math.min(20, Math.max(0, -Math.floor(Math.log10(step) + 1e-9)))).replace("-", "−");
  }

  // What the colours mean.

  function roundBetween(low, high) {
    const power = 10 ** Math.floor(Math.log10((high - low) / 4));
    const step = power * [1, 2, 5, 10].find((nice) => nice * power >= (high - low) / 6);
    const values = [];
    for (let k = Math.ceil(low / step); k * step <= high; k++) values.push(k * step);
    return values.map((value) => [value, toStep(value, step)]);
  }

  function showKey() {
    const part = (name, parent, text = "") => {
      const made = parent.appendChild(document.createElement(name === "b" ? "b" : "div"));
      if (name !== "b") made.className = name;
      made.textContent = text;
      return made;
    };
    const box = byId("key");
    box.replaceChildren();
    if (scene.scales[channel]) showScale(part, box, scene.scales[channel]);
    const has = (map, is) => map.values[channel].some((value, v) => is(Number.isFinite(value), map.filled && map.filled[v]));
    const isOutlined = forms[0].borders.x.length > 0;
    const isFilled = isOutlined || maps.some((map) => has(map, (isKnown, filled) => isKnown && filled));
    const isMissing = maps.some((map) => has(map, (isKnown) => !isKnown));
    const legend = (text, looks) => {
      const line = part("legend", box);
      const swatch = line.appendChild(document.createElement("span"));
      swatch.className = "swatch";
      Object.assign(swatch.style, looks);
      line.append(text);
    };
    if (isMissing) legend("missing", { background: rgb(scene.greys[0]) });
    if (isFilled) legend(isOutlined ? "filled in: paler, outlined" : "filled in: paler", { background: `linear-gradient(to right, ${[0, 64, 128, 192, 255].map((k) => rgb(pale[k])).join(", ")})`, border: isOutlined ? `3px solid ${scene.outline}` : "" });
    for (const [key, there] of [["f", isOutlined], ["m", isMissing && Boolean(scene.scales[channel])]]) toggle(key).hidden = !there;
  }

  const rgb = (colour) => `rgb(${colour.map((part) => 255 * part).join(" ")})`;

  function showScale(part, box, { low, high, cyclic }) {
    const steps = Array.from({ length: 33 }, (_, k) => css(Math.min(8 * k, 255)));
    if (cyclic) {
      const wheel = part("wheel", box);
      // Angles as they point: 0 to the right, and counter-clockwise.
      const period = high - low;
      part("colours", wheel).style.background = `conic-gradient(from ${90 - (360 * low) / period}deg, ${steps.reverse().join(", ")})`;
      part("hole", wheel);
      for (let quarter = 0; quarter < 4; quarter++) {
        const value = (quarter * period) / 4;
        const label = part("b", wheel, toStep(value < high ? value : value - period, period / 40) + scene.unit);
        label.className = ["right", "top", "left", "bottom"][quarter];
      }
      // Polar angles of the visual field, where 90 is up.
      for (const [x, y, words] of !scene.isVisualField ? [] : [[1, 1, "upper right"], [-1, 1, "upper left"], [-1, -1, "lower left"], [1, -1, "lower right"]]) {
        const label = part("quadrant", wheel, words);
        label.style.left = `${125 + 70 * x}px`;
        label.style.top = `${85 - 58 * y}px`;
      }
    } else {
      const bar = part("bar", box);
      part("colours", bar).style.background = `linear-gradient(to top, ${steps.join(", ")})`;
      for (const [value, text] of roundBetween(low, high)) {
        part("b", bar, text).style.bottom = `${(100 * (value - low)) / (high - low)}%`;
      }
    }
  }

  // Buttons and keys.

  const toggle = (key) => document.querySelector(`button[data-key="${key}"]`);

  function setShown(key, on) {
    const button = toggle(key);
    shown[key] = on;
    if (button) button.setAttribute("aria-pressed", on);
    if (key === "i") {
      for (const pane of panes) if (pane.form.name === "inflated") pane.row.hidden = !on;
      if (on) look(camera);
      return;
    }
    const place = key === "m" ? 1 : 2;
    for (const pane of panes) {
      const there = place === 1 ? pane.plot.data[1].i.length > 0 : pane.form.borders.x.length > 0;
      if (pane.plot.data[place].visible !== (there && on)) Plotly.restyle(pane.plot, { visible: there && on }, [place]);
    }
  }

  function swap(next) {
    turn = next % maps.length;
    for (const pane of panes) pane.figure.style.order = (pane.m + maps.length - turn) % maps.length;
  }

  function bind() {
    const names = { i: "Inflated", f: "Outline of filled", m: "Missing" };
    for (const key of Object.keys(names)) {
      if (!toggle(key)) continue;
      actions[key] = () => {
        if (toggle(key).hidden) return;
        setShown(key, !shown[key]);
        say(`${names[key]} ${shown[key] ? "shown" : "hidden"}`);
      };
    }
    for (const [k, view] of scene.views.entries()) {
      const from = facing(view.camera);
      actions[k + 1] = () => { look(from(), view.name); say(`View: ${view.name}`); };
    }
    if (maps.length > 1) actions.b = () => { swap(turn + 1); say(`First: ${maps[turn].title}`); };
    actions["?"] = () => byId("help").showModal();
    actions.r = () => {
      for (const key of Object.keys(names)) if (toggle(key)) setShown(key, true);
      swap(0);
      if (channelSelect && channel !== 0) showChannel(0);
      look(best(), scene.best.name);
      say("Reset");
    };
  }

  makePanes();
  camera = best();
  tellView(scene.best.name);
  letter();
  bind();
  showKey();
  onChannel = () => {
    for (const pane of panes) Plotly.react(pane.plot, traces(pane.form, pane.map), layout(), options);
    showKey();
  };
  const drawn = panes.map((pane) => Plotly.newPlot(pane.plot, traces(pane.form, pane.map), layout(), options));
  for (const pane of panes) listen(pane);
  Promise.all(drawn).then(() => { byId("panes").dataset.ready = "yes"; });
}
