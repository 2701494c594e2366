// The page of tessera-web: shows a view that the server keeps rendering, moves its camera, picks
// and drags objects, edits materials and lights. What it says and hears, client/web_viewer.h tells.

const element = id => document.getElementById(id);
const canvas = element("picture"), context = canvas.getContext("2d");

// ---- Vectors ------------------------------------------------------------------------------------

const add = (a, b) => a.map((x, i) => x + b[i]);
const sub = (a, b) => a.map((x, i) => x - b[i]);
const scale = (a, s) => a.map(x => x * s);
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const length = a => Math.sqrt(dot(a, a));
const normalize = a => scale(a, 1 / length(a));
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const rotated = (v, axis, angle) => add(add(scale(v, Math.cos(angle)), scale(cross(axis, v), Math.sin(angle))),
                                        scale(axis, dot(axis, v) * (1 - Math.cos(angle))));

// ---- Cameras: a gesture in parts of the picture's height, y upwards, makes another camera --------

const pole = 0.02;  // radians that the view stays away from straight up and down

function axes(camera) {
  const forward = normalize(sub(camera.at, camera.eye));
  const right = normalize(cross(forward, camera.up));
  return {right, up: cross(right, forward), forward};
}

function orbited(camera, [x, y]) {
  const up = normalize(camera.up), view = sub(camera.at, camera.eye);
  const elevation = Math.asin(clamp(dot(normalize(view), up), -1, 1));
  const most = Math.PI / 2 - pole;
  const wanted = clamp(elevation - Math.PI * y, -most, Math.max(most, elevation));
  const lifted = rotated(view, normalize(cross(view, up)), wanted - elevation);
  return {...camera, eye: sub(camera.at, rotated(lifted, up, -Math.PI * x))};
}

/** Tangent of half the angle that is seen from bottom to top: in an upright window more than the camera says, which is
    then from side to side. */
const opening = camera => Math.tan(camera.fov * Math.PI / 360) * Math.max(1, canvas.clientHeight / canvas.clientWidth);

function panned(camera, [x, y]) {
  const {right, up} = axes(camera);
  const height = 2 * length(sub(camera.at, camera.eye)) * opening(camera);
  const by = scale(add(scale(right, x), scale(up, y)), -height);
  return {...camera, eye: add(camera.eye, by), at: add(camera.at, by)};
}

function approached(camera, factor) {
  // Nearer than this, rounding would turn the view.
  const nearest = 1e-3 * (1 + length(camera.at)), away = sub(camera.eye, camera.at);
  return {...camera, eye: add(camera.at, scale(away, Math.max(1 / factor, nearest / length(away))))};
}

function flown(camera, [x, y, z]) {
  const {right, forward} = axes(camera);
  const by = add(add(scale(right, x), scale(normalize(camera.up), y)), scale(forward, z));
  return {...camera, eye: add(camera.eye, by), at: add(camera.at, by)};
}

/** Where the ray through a point of the picture meets the ground plane through `p`, or null. */
function onGround(camera, [x, y], p) {
  const {right, up, forward} = axes(camera);
  const direction = add(forward, scale(add(scale(right, x), scale(up, y)), opening(camera)));
  const t = dot(sub(p, camera.eye), camera.up) / dot(direction, camera.up);
  return t > 0 && Number.isFinite(t) ? add(camera.eye, scale(direction, t)) : null;
}

// ---- Colours: linear light as a hue of at most 1, in sRGB, and a strength ------------------------

const toSrgb = x => x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055;
const fromSrgb = x => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
const hexOf = rgb =>
  "#" + rgb.map(x => Math.round(255 * toSrgb(clamp(x, 0, 1))).toString(16).padStart(2, "0")).join("");
const rgbOf = hex => [1, 3, 5].map(i => fromSrgb(parseInt(hex.slice(i, i + 2), 16) / 255));
const strengthOf = rgb => Math.max(...rgb);
const hueOf = rgb => strengthOf(rgb) > 0 ? scale(rgb, 1 / strengthOf(rgb)) : [1, 1, 1];

// ---- What is shown --------------------------------------------------------------------------------

const quickPixels = 450000;  // pictures of more pixels are made smaller unless the user says otherwise

let about = null;      // scene, cameras, lights, selection, as the gateway tells
let camera = null;
let picture = null;    // what is known of the one on the screen
let material = "";     // of the selection: whose controls are shown
const display = {exposure: 0, filmic: true, channel: "picture", reference: false, divisor: 0};
const series = {first: [], latency: [], error: []};
const drawnAt = [];    // times of the last pictures, ms

function pictureSize() {
  const pixels = window.devicePixelRatio || 1;
  const width = canvas.clientWidth * pixels, height = canvas.clientHeight * pixels;
  let divisor = Math.max(display.divisor, 1);
  if (display.divisor === 0) divisor = Math.max(1, Math.sqrt(width * height / quickPixels));
  return [Math.max(Math.floor(width / divisor), 16), Math.max(Math.floor(height / divisor), 16)];
}

function currentView() {
  const {exposure, filmic, channel, reference} = display;
  const {eye, at, up} = camera, fov = Math.atan(opening(camera)) * 360 / Math.PI;
  return {camera: {eye, at, up, fov}, size: pictureSize(), exposure, filmic, channel, reference};
}

// ---- The gateway ----------------------------------------------------------------------------------

let socket = null;
let retryAfter = 500;        // ms
let asked = "";              // the view last asked for
let stamp = 0;
const askedAt = new Map();   // stamp -> ms
const edits = new Map();     // what has changed since the last frame, the last value of each
let picks = 0;
const awaited = new Map();   // number of a pick -> who waits for its answer

function connect() {
  socket = new WebSocket(location.href.replace(/^http/, "ws").replace(/[?#].*$/, ""));
  socket.binaryType = "arraybuffer";
  socket.onmessage = ({data}) => typeof data === "string" ? hear(JSON.parse(data)) : receive(data);
  socket.onopen = () => { asked = ""; };
  socket.onclose = ({reason}) => {
    notice(`${reason || "The gateway cannot be reached"}; trying again`, retryAfter + 2000);
    setTimeout(connect, retryAfter);
    retryAfter = Math.min(2 * retryAfter, 10000);
    answerPicks({number: picks});
  };
}

const say = message => socket.readyState === WebSocket.OPEN && socket.send(JSON.stringify(message));

function hear(message) {
  if (message.about) {
    const first = !about;
    about = message.about;
    if (first) camera = about.home;
    if (first) document.title = `${about.scene} - Tessera`;
    retryAfter = 500;
    showScene();
  }
  if (message.picked) answerPicks(message.picked);
  if (message.status) showStatus(message.status);
  if (message.motion) showMotion(message.motion);
  if (message.coming) comingSince = performance.now();
  if (message.notice) notice(message.notice);
}

/** Asks for what has changed, at most once a frame, and only when what was said before is on its way. */
function speak() {
  if (!camera || socket.readyState !== WebSocket.OPEN || socket.bufferedAmount > 0) return;
  for (const edit of edits.values()) say({edit});
  edits.clear();
  const view = currentView(), now = JSON.stringify(view);
  if (now === asked) return;
  asked = now;
  askedAt.set(++stamp, performance.now());
  say({view: {...view, stamp}});
}

function change(set, name, field, value) {
  const key = `${set} ${name}`, to = edits.get(key)?.to;
  edits.set(key, {set, name, to: {...to, [field]: value}});
}

/** What lies at a point of the picture: {instance, material, point, origin}, or without them. */
function pick(point) {
  return new Promise(resolve => {
    awaited.set(++picks, resolve);
    say({pick: point, number: picks});
  });
}

/** A newer answer may have taken the place of older ones. */
function answerPicks(answer) {
  for (const [number, resolve] of awaited) {
    if (number > answer.number) continue;
    awaited.delete(number);
    resolve(number === answer.number ? answer : {});
  }
}

let comingSince = 0;         // ms: when the page was told that a picture comes

async function receive(data) {
  const seconds = (performance.now() - comingSince) / 1000;
  const headerLength = new DataView(data).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, headerLength)));
  try {
    const bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + headerLength)], {type: header.type}));
    if (!picture || header.stamp >= picture.stamp) showPicture(header, bitmap);
    bitmap.close();
  } finally {
    say({shown: true, seconds});
  }
}

function showPicture(header, bitmap) {
  const first = !picture || header.stamp !== picture.stamp || header.version !== picture.version;
  if (canvas.width !== bitmap.width) canvas.width = bitmap.width;
  if (canvas.height !== bitmap.height) canvas.height = bitmap.height;
  context.drawImage(bitmap, 0, 0);
  const now = performance.now();
  drawnAt.push(now);
  if (first) keep(series.first, 1000 * header.first_seconds);
  if (header.error > 0) keep(series.error, header.error);
  if (askedAt.has(header.stamp)) keep(series.latency, now - askedAt.get(header.stamp));
  for (const key of askedAt.keys()) if (key <= header.stamp) askedAt.delete(key);
  picture = header;
  showStatistics();
}

function keep(values, value) {
  values.push(value);
  if (values.length > 120) values.shift();
}

// ---- Controls: each makes a row, and returns how to show another value ------------------------------

function make(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

function row(parent, name, ...children) {
  parent.append(make("label", {className: "row"}, make("span", {textContent: name}), ...children));
}

/** Not under the user's hand. */
const free = input => document.activeElement !== input || !input.matches(":active");

function textRow(parent, name) {
  const text = make("span", {className: "wide"});
  row(parent, name, text);
  return value => { text.textContent = value; };
}

function plotRow(parent, name) {
  const plot = make("canvas", {width: 260, height: 52}), value = make("output");
  row(parent, name, plot, value);
  const pen = plot.getContext("2d");
  return (values, text) => {
    value.textContent = text;
    pen.clearRect(0, 0, plot.width, plot.height);
    pen.strokeStyle = getComputedStyle(document.body).getPropertyValue("--accent");
    pen.lineWidth = 2;
    pen.beginPath();
    const most = 1.2 * Math.max(...values, 1e-9);
    values.forEach((v, i) => pen.lineTo(plot.width * i / 119, plot.height * (1 - v / most)));
    pen.stroke();
  };
}

function sliderRow(parent, name, [min, max, step], text, onInput) {
  const input = make("input", {type: "range", min, max, step}), value = make("output");
  row(parent, name, input, value);
  const show = x => {
    if (free(input)) input.value = x;
    value.textContent = text(x);
  };
  input.oninput = () => {
    value.textContent = text(Number(input.value));
    onInput(Number(input.value));
  };
  return show;
}

function colourRow(parent, name, onInput) {
  const input = make("input", {type: "color", className: "wide"});
  row(parent, name, input);
  input.oninput = () => onInput(rgbOf(input.value));
  return rgb => { if (free(input)) input.value = hexOf(rgb); };
}

function choiceRow(parent, name, choices, onInput) {
  const select = make("select", {className: "wide"}, ...choices.map(([value, text]) => new Option(text, value)));
  row(parent, name, select);
  select.onchange = () => onInput(select.value);
  return value => { select.value = value; };
}

/** Light as a hue and a strength in steps that look alike; the lowest is darkness. */
function lightRows(parent, hueName, strengthName, onInput) {
  let hue = [1, 1, 1], strength = 0;
  const tell = () => onInput(scale(hue, strength));
  const showHue = colourRow(parent, hueName, value => { hue = hueOf(value); tell(); });
  const darkness = -10;
  const strengthAt = step => step <= darkness ? 0 : 2 ** step;
  const showStrength = sliderRow(parent, strengthName, [darkness, 14, 0.1],
    step => strengthAt(step).toPrecision(3).replace(/\.?0+$/, ""),
    step => { strength = strengthAt(step); tell(); });
  return rgb => {
    strength = strengthOf(rgb);
    if (strength > 0) hue = hueOf(rgb);
    showHue(hue);
    showStrength(strength > 0 ? Math.log2(strength) : darkness);
  };
}

// ---- The panel ----------------------------------------------------------------------------------------

const show = {
  size: textRow(element("statistics"), "picture"),
  speed: textRow(element("statistics"), "speed"),
  frames: textRow(element("statistics"), "frames"),
  first: plotRow(element("statistics"), "first pass"),
  latency: plotRow(element("statistics"), "latency"),
  error: plotRow(element("statistics"), "error"),
  cluster: textRow(element("statistics"), "cluster"),
  viewers: textRow(element("statistics"), "viewers"),
};

function buildDisplay(parent) {
  const channels = ["picture", "direct light", "indirect light", "irradiance", "albedo", "normal", "depth",
                    "path length", "error", "tile owner"];
  choiceRow(parent, "show", channels.map(name => [name, name]), value => {
    display.channel = value;
    showLegend();
  });
  sliderRow(parent, "exposure", [-8, 8, 0.05], x => x.toFixed(2), x => { display.exposure = x; })(0);
  choiceRow(parent, "tone", [["filmic", "filmic"], ["plain", "plain sRGB"]],
    value => { display.filmic = value === "filmic"; });
  choiceRow(parent, "size", [[0, "as is quick"], [1, "full"], [2, "half"], [3, "a third"], [4, "a quarter"]],
    value => { display.divisor = Number(value); });
  choiceRow(parent, "light", [["interactive", "interactive"], ["reference", "reference"]],
    value => { display.reference = value === "reference"; });
}

/** The colours of numbers are viridis, as the server paints them. */
function showLegend() {
  const marks = {
    "depth": ["far", "3 m", "1 m", "1/3 m", "0"],
    "path length": ["1", "2", "3", "4", "5", "6", "7", "8+"],
    "error": ["0.0001", "0.001", "0.01", "0.1", "1"],
  }[display.channel] ?? [];
  const owners = display.channel === "tile owner" ? cluster?.owners ?? [] : [];
  element("legend").hidden = !marks.length && !owners.length;
  element("legend").replaceChildren(
    make("strong", {textContent: display.channel}),
    ...(marks.length ? [make("div", {className: "ramp"}),
                make("div", {className: "marks"}, ...marks.map(textContent => make("span", {textContent})))] : []),
    ...owners.map(({name, colour}) => {
      const key = make("span", {className: "key"});
      key.style.background = `rgb(${colour})`;
      return make("div", {}, key, name);
    }));
}

let cluster = null;  // as the gateway told last

/** {seconds, duration, playing} of what moves by itself. */
let motion = null;

function showMotion(now) {
  motion = now;
  element("motion").hidden = false;
  element("play").textContent = now.playing ? "pause" : "play";
  const slider = element("seconds");
  slider.max = now.duration;
  if (free(slider)) slider.value = now.seconds;
  slider.nextElementSibling.textContent = `${now.seconds.toFixed(1)} s`;
}

const togglePlay = () => motion && say({play: !motion.playing});

function showStatistics() {
  const rate = picture.render_seconds > 0 ? picture.passes / picture.render_seconds : 0;
  const rays = picture.render_seconds > 0 ? 1e-6 * picture.rays / picture.render_seconds : 0;
  const newest = values => values.length ? values[values.length - 1] : 0;
  element("progress").firstElementChild.style.width = `${100 * Math.min(picture.passes / about.passes, 1)}%`;
  show.size(`${picture.width} x ${picture.height}, ` +
            (picture.settled ? "settled" : `pass ${picture.passes} of ${about.passes}`));
  show.speed(`${rate.toFixed(1)} passes/s, ${rays.toFixed(1)} Mrays/s`);
  show.first(series.first, `${newest(series.first).toFixed(0)} ms`);
  show.latency(series.latency, `${newest(series.latency).toFixed(0)} ms`);
  show.error(series.error, series.error.length ? newest(series.error).toFixed(4) : "");
}

function showStatus(status) {
  const many = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
  show.cluster(`${many(status.workers, "worker")}, ${many(status.threads, "thread")}`);
  show.viewers(`${status.viewers}`);
  cluster = status;
  if (display.channel === "tile owner") showLegend();
  const now = performance.now();
  while (drawnAt.length && drawnAt[0] < now - 2000) drawnAt.shift();
  show.frames(`${(drawnAt.length / 2).toFixed(1)} per second`);
}

/** Makes the controls of a section anew when what they are for has changed, and shows the values. */
function showSection(id, names, build, values) {
  const section = element(id), key = JSON.stringify(names);
  if (section.key !== key) {
    section.key = key;
    section.replaceChildren();
    section.show = build(section);
  }
  section.show(values);
}

function showScene() {
  element("scene").textContent = about.scene;
  element("version").textContent = `version ${about.version}`;
  showSection("selection", [about.selection?.instance, about.selection?.materials.map(m => m.name), material],
              buildSelection, about.selection);
  showSection("lights", about.lights.map(light => [light.set, light.name]), buildLights, about.lights);
  showSection("cameras", about.cameras.map(c => c.name), buildCameras, about.cameras);
  element("chip").hidden = !about.selection;
  element("chip").textContent = about.selection?.instance;
}

function buildSelection(parent) {
  const {selection} = about;
  if (!selection) {
    parent.append(make("p", {className: "quiet", textContent: "click an object; drag to move it"}));
    return () => {};
  }
  parent.append(make("h3", {textContent: selection.instance}));
  const showPlace = textRow(parent, "place");
  const names = selection.materials.map(m => m.name);
  if (!names.includes(material)) material = names[0];
  choiceRow(parent, "material", names.map(name => [name, name]),
            value => { material = value; showScene(); })(material);
  const name = material, set = (field, value) => change("material", name, field, value);
  const number = x => x.toFixed(2);
  const controls = {
    base_color: colourRow(parent, "colour", rgb => set("base_color", rgb)),
    roughness: sliderRow(parent, "roughness", [0, 1, 0.01], number, x => set("roughness", x)),
    metallic: sliderRow(parent, "metallic", [0, 1, 0.01], number, x => set("metallic", x)),
    emission: lightRows(parent, "glow", "radiance", rgb => set("emission", rgb)),
  };
  return now => {
    showPlace(now.place.map(number).join(", "));
    const shown = now.materials.find(m => m.name === name);
    for (const [field, showValue] of Object.entries(controls)) showValue(shown[field]);
  };
}

function buildLights(parent) {
  const controls = about.lights.map(({set, name, field}) => {
    parent.append(make("h3", {textContent: name}));
    return lightRows(parent, "colour", field === "emission" ? "radiance" : "intensity",
                     rgb => change(set, name, field, rgb));
  });
  return lights => lights.forEach((light, i) => controls[i](light.value));
}

function buildCameras(parent) {
  const button = (text, chosen) =>
    parent.append(make("button", {type: "button", textContent: text, onclick: () => { camera = chosen(); }}));
  about.cameras.forEach((c, i) => button(c.name, () => about.cameras[i]));
  button("where it began", () => about.home);
  return () => {};
}

let noticeTimer = 0;
function notice(text, time = 4000) {
  element("notice").textContent = text;
  element("notice").hidden = false;
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => { element("notice").hidden = true; }, time);
}

function togglePanel() { document.body.classList.toggle("folded"); }

function savePicture() {
  canvas.toBlob(blob => {
    const link = make("a", {href: URL.createObjectURL(blob), download: `${about.scene}.png`});
    link.click();
    URL.revokeObjectURL(link.href);
  });
}

// ---- The user: pointers -------------------------------------------------------------------------------

const fingers = new Map();  // pointer -> where it was last
let gesture = "none";       // or orbit, pan, asking, object
let began = null;           // where the first went down
let moved = 0;              // pixels from there, at most
let asking = null;          // what lies there, soon
let grip = null;            // what is held: {instance, point, origin}

/** (0, 0) is the picture's centre, (0, 1) the middle of its upper edge. */
function picturePoint({x, y}) {
  const {left, top, width, height} = canvas.getBoundingClientRect();
  return [(2 * (x - left) - width) / height, (height - 2 * (y - top)) / height];
}

function middle() {
  const points = [...fingers.values()];
  return {x: points.reduce((sum, p) => sum + p.x, 0) / points.length,
          y: points.reduce((sum, p) => sum + p.y, 0) / points.length};
}

function spread() {
  const [a, b] = fingers.values();
  return b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
}

canvas.onpointerdown = async event => {
  if (!camera) return;
  canvas.setPointerCapture(event.pointerId);
  document.activeElement.blur();
  if (fingers.size === 0) [began, moved] = [event, 0];
  fingers.set(event.pointerId, {x: event.x, y: event.y});
  canvas.classList.add("dragging");
  gesture = fingers.size > 1 || event.button !== 0 || event.shiftKey ? "pan" : "orbit";
  if (gesture !== "orbit" || !about.selection) return;
  // What is selected is taken hold of.
  gesture = "asking";
  asking = pick(picturePoint(event));
  const picked = await asking;
  if (gesture !== "asking") return;
  grip = picked;
  gesture = picked.instance && picked.instance === about.selection?.instance ? "object" : "orbit";
};

canvas.onpointermove = event => {
  if (!fingers.has(event.pointerId)) return;
  moved = Math.max(moved, Math.hypot(event.x - began.x, event.y - began.y));
  if (moved < 4 || gesture === "asking") return;
  const from = middle(), wide = spread(), height = canvas.clientHeight;
  fingers.set(event.pointerId, {x: event.x, y: event.y});
  const to = middle(), by = [(to.x - from.x) / height, (from.y - to.y) / height];
  if (gesture === "orbit") camera = orbited(camera, by);
  if (gesture === "pan") camera = panned(camera, by);
  if (gesture === "object") dragSelection(picturePoint(event));
  if (wide > 0) camera = approached(camera, spread() / wide);
};

canvas.onpointerup = canvas.onpointercancel = async event => {
  // A drag may be over before it is known of what.
  if (gesture === "asking" && moved >= 4) {
    await asking;
    canvas.onpointermove(event);
  }
  if (!fingers.delete(event.pointerId)) return;
  const click = event.type === "pointerup" && event.button === 0 && moved < 4 && gesture !== "pan";
  // The finger that is left does not begin to turn the view.
  if (fingers.size > 0) return;
  gesture = "none";
  canvas.classList.remove("dragging");
  if (!click) return;
  const picked = await pick(picturePoint(event));
  material = picked.material ?? "";
  say({select: picked.instance ?? ""});
};

canvas.oncontextmenu = event => event.preventDefault();
canvas.addEventListener("wheel", event => {
  event.preventDefault();
  const lines = event.deltaMode === 0 ? event.deltaY / 100 : event.deltaY / 3;
  if (camera) camera = approached(camera, 1.12 ** -clamp(lines, -4, 4));
}, {passive: false});

/** Moves it in its ground plane, so that the point that was taken hold of stays under the pointer. */
function dragSelection(point) {
  const to = onGround(camera, point, grip.point);
  if (to) edits.set("move", {move: grip.instance, to: add(to, sub(grip.origin, grip.point))});
}

// ---- The user: keys -----------------------------------------------------------------------------------

const down = new Set();

const keys = {
  KeyT: togglePanel,
  KeyH: () => { element("help").open = !element("help").open; },
  KeyP: savePicture,
  Space: togglePlay,
  Home: () => { camera = about.home; },
  Escape: () => say({select: ""}),
  Delete: () => about.selection && say({edit: {delete: about.selection.instance}}),
};

window.onkeydown = event => {
  const typing = event.target.matches("select") || (event.target.matches("input") && event.code === "Home");
  if (typing || !about || event.ctrlKey || event.metaKey || event.altKey) return;
  down.add(event.code);
  if (!keys[event.code]) return;
  event.preventDefault();
  keys[event.code]();
};
window.onkeyup = event => down.delete(event.code);
window.onblur = () => down.clear();

/** Keys that are held down move the eye: a third of the way to the point looked at in a second. */
function fly(seconds) {
  const axis = (plus, minus) => down.has(plus) - down.has(minus);
  const by = [axis("KeyD", "KeyA"), axis("KeyE", "KeyQ"), axis("KeyW", "KeyS")];
  if (!camera || dot(by, by) === 0) return;
  const fast = down.has("ShiftLeft") || down.has("ShiftRight") ? 3 : 1;
  camera = flown(camera, scale(by, seconds * fast * length(sub(camera.at, camera.eye)) / 3));
}

// ---- Beginning ----------------------------------------------------------------------------------------

element("toggle").onclick = togglePanel;
element("play").onclick = togglePlay;
element("seconds").oninput = () => say({seek: Number(element("seconds").value)});
if (matchMedia("(max-width: 700px)").matches) togglePanel();
buildDisplay(element("display"));
connect();
let before = performance.now();
requestAnimationFrame(function frame(now) {
  fly(Math.min((now - before) / 1000, 0.1));
  before = now;
  speak();
  requestAnimationFrame(frame);
});
