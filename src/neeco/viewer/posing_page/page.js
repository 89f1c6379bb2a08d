"use strict";
const $ = id => document.getElementById(id);
const STRIP = [-12, -6, -3, -1, 0, 1, 3, 6, 12];  // frames about the asked one
const STEP = 2, LEAP = 10;  // degrees of a key
const HINGE = 0.36, SHARE = 50;  // of the working length; percent: where lines begin
const GONE = "neeco does not answer: is it still running?";
const PIN = "#35b6ff", JAW = "#ff9a1f";

let overview, frame, pose, shown, displayed = null, hidden = false, ghost = null, ghosted = false, busy = false, skipped = new Set(), timer = null;
const lines = { hinge: null, share: SHARE };

// questions over the web socket are answered in their order; pictures come by GET, side by side
const socket = new WebSocket(location.href.split("#")[0].replace("http", "ws")), waiting = [];
const opened = new Promise(done => { socket.onopen = socket.onerror = done; });
socket.onmessage = event => waiting.shift()(JSON.parse(event.data));
socket.onclose = () => waiting.splice(0).forEach(done => done({ error: GONE }));

async function ask(what, fields = {}) {
  await opened;
  if (socket.readyState !== WebSocket.OPEN) throw new Error(GONE);
  socket.send(JSON.stringify({ ask: what, instrument: overview ? overview.instrument : "", ...fields }));
  const answer = await new Promise(done => waiting.push(done));
  if (answer.error) throw new Error(answer.error);
  return answer;
}

function fail(error) {
  $("failed").textContent = error.message;
  $("failed").hidden = false;
}

const address = (what, fields) => `${location.pathname.replace(/\/?$/, "/")}${what}/${encodeURIComponent(JSON.stringify({ instrument: overview.instrument, ...fields }))}`;

async function image(what, fields) {
  const answer = await fetch(address(what, fields)).catch(() => { throw new Error(GONE); });
  if (!answer.ok) throw new Error(await answer.text());
  return createImageBitmap(await answer.blob());
}

const picture = index => image("picture", { index, small: false });

// pictures come in any order: only the one that was requested last is shown, of the frame that was visited last
let visits = 0, requests = 0;

async function go(index, reason) {
  stop();
  const visit = ++visits, request = ++requests;
  const picturing = picture(index);  // side by side
  picturing.catch(() => {});  // reported below
  frame = await ask("frame", { index });
  pose = { roll: frame.roll.value, joints: {} };
  for (const [name, known] of Object.entries(frame.joints)) pose.joints[name] = known.value;
  const pictured = await picturing;
  if (visit !== visits) return;
  if (request === requests) [displayed, shown] = [pictured, index];
  $("why").textContent = `frame ${frame.name}` + (reason ? `: ${reason}` : "");
  $("failed").hidden = true;
  sliders();
  strip();
  draw();
  haunt();
}

// the trained scene at the sliders' state; one rendering at a time, the last one requested
let haunting = false, wished = false;
async function haunt() {
  wished = true;
  if (!ghosted || haunting) return;
  haunting = true;
  while (wished) {
    wished = false;
    ghost = await image("ghost", { index: frame.index, ...pose }).catch(() => null);
    draw();
  }
  haunting = false;
}

function next() {
  const open = overview.suggested.filter(item => !skipped.has(item.frame));
  if (!open.length) skipped.clear();
  const item = open[0] || overview.suggested[0];
  if (!item) return Promise.reject(new Error("no other frame shows the instrument's wrist"));
  return go(item.frame, item.reason);
}

// a point of the instrument, mm along the shaft, across and towards the camera -> the picture's pixels
function place(along, across, towards) {
  const nearer = frame.origin_towards / (frame.origin_towards + towards);
  const a = nearer * (frame.origin_along + along) - frame.origin_along, b = nearer * across;
  const [left, right, top] = overview.window, scale = $("canvas").width / (right - left);
  return [(a - left) * scale, (b - top) * scale];
}

// of the instrument's frame: x along the pin, y across it, z along the shaft
function point(x, y, z) {
  const roll = pose.roll * Math.PI / 180, c = Math.cos(roll), s = Math.sin(roll);
  return place(z, s * x + c * y, c * x - s * y);
}

function stroke(context, points, color, width, dash = []) {
  for (const [style, wide] of [["rgba(0,0,0,.65)", width + 2.5], [color, width]]) {
    context.strokeStyle = style;
    context.lineWidth = wide * devicePixelRatio;
    context.setLineDash(dash.map(length => length * devicePixelRatio));
    context.beginPath();
    points.forEach(([x, y], i) => i ? context.lineTo(x, y) : context.moveTo(x, y));
    context.stroke();
  }
}

function draw() {
  const canvas = $("canvas"), box = $("stage").getBoundingClientRect();
  const ratio = displayed.height / displayed.width;
  const width = Math.max(200, Math.min(box.width, box.height / ratio));
  canvas.style.width = `${width}px`;
  canvas.style.height = `${width * ratio}px`;
  canvas.width = Math.round(width * devicePixelRatio);
  canvas.height = Math.round(width * ratio * devicePixelRatio);
  $("why").style.left = `${(box.width - width) / 2 + 8}px`;
  $("why").style.top = `${(box.height - width * ratio) / 2 + 8}px`;
  const context = canvas.getContext("2d");
  context.imageSmoothingQuality = "high";
  context.drawImage(displayed, 0, 0, canvas.width, canvas.height);
  if (shown !== frame.index) return;
  if (ghosted && ghost) {
    context.globalAlpha = 0.6;
    context.drawImage(ghost, 0, 0, canvas.width, canvas.height);
    context.globalAlpha = 1;
  }
  if (hidden) return;
  context.lineCap = "round";
  const hinge = lines.hinge, radius = overview.radius, reach = overview.length - hinge;
  // the pin, sticking out of the wrist; the wrist's face at its marked end, dashed where it is turned away
  const facing = Math.cos(pose.roll * Math.PI / 180) > 0;
  stroke(context, [point(radius, 0, 0), point(radius, 0, hinge)], PIN, 1.5, facing ? [] : [3, 6]);
  stroke(context, [point(-1.7 * radius, 0, hinge), point(1.7 * radius, 0, hinge)], PIN, 3);
  const [x, y] = point(1.7 * radius, 0, hinge);
  context.setLineDash([]);
  context.beginPath();
  context.arc(x, y, 6 * devicePixelRatio, 0, 2 * Math.PI);
  context.lineWidth = 2.5 * devicePixelRatio;
  context.strokeStyle = facing ? "rgba(0,0,0,.65)" : PIN;
  context.fillStyle = facing ? PIN : "rgba(0,0,0,.65)";
  context.fill();
  context.stroke();
  const joint = Object.keys(pose.joints)[0];
  if (joint === undefined) return;
  const opening = pose.joints[joint] * Math.PI / 180, share = lines.share / 100;
  for (const angle of [-opening * share, opening * (1 - share)])
    stroke(context, [point(0, 0, hinge), point(0, reach * Math.sin(angle), hinge + reach * Math.cos(angle))], JAW, 3);
}

function slider(label, kind, low, high, value, change, deviation) {
  const row = document.createElement("label"), said = document.createElement("output"), input = document.createElement("input");
  const name = label.replaceAll("_", " ");
  row.append(name, said, input);
  Object.assign(input, { type: "range", min: low, max: high, step: 1, value, className: kind, ariaLabel: name });
  const show = () => input.ariaValueText = said.textContent = `${Math.round(input.value)}°` + (deviation ? `  (expected ± ${Math.round(deviation)}°)` : "");
  input.oninput = () => { change(Number(input.value)); show(); draw(); haunt(); };
  show();
  return row;
}

function sliders() {
  const rows = [slider("roll", "pin", -180, 180, pose.roll, value => pose.roll = value, overview.done ? frame.roll.deviation : 0)];
  for (const [name, [low, high]] of Object.entries(overview.joints)) {
    const deviation = overview.done ? frame.joints[name].deviation : 0;
    rows.push(slider(name, "jaw", low, high, pose.joints[name], value => pose.joints[name] = value, deviation));
  }
  $("sliders").replaceChildren(...rows);
}

function turn(what, degrees) {
  if (shown !== frame.index) return show(frame.index);
  if (what === "roll") pose.roll = (pose.roll + degrees + 540) % 360 - 180;
  else {
    const name = Object.keys(pose.joints)[0];
    if (name === undefined) return;
    const [low, high] = overview.joints[name];
    pose.joints[name] = Math.min(high, Math.max(low, pose.joints[name] + degrees));
  }
  sliders();
  draw();
  haunt();
}

function strip() {
  const indices = STRIP.map(step => frame.index + step).filter(index => index >= 0 && index < overview.frames);
  $("strip").replaceChildren(...indices.map(index => {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    const src = address("picture", { index, small: true });
    figure.append(Object.assign(new Image(), { src, alt: `frame ${index}`, onerror: () => fail(new Error(GONE)) }));
    const apart = index - frame.index;
    caption.textContent = apart ? (apart > 0 ? `+${apart}` : `${apart}`) : "this frame";
    figure.dataset.index = index;
    figure.append(caption);
    figure.onclick = () => show(index);
    return figure;
  }));
  mark();
}

function mark() {
  for (const figure of $("strip").children)
    figure.toggleAttribute("aria-current", Number(figure.dataset.index) === shown);
}

// another frame in the large picture, to look at
async function show(index) {
  stop();
  const request = ++requests, pictured = await picture(index);
  if (request !== requests) return;
  displayed = pictured;
  shown = index;
  mark();
  draw();
}

function stop() {
  clearInterval(timer);
  timer = null;
}

async function play() {
  if (timer) return show(frame.index);
  const first = Math.max(0, frame.index - 12), last = Math.min(overview.frames - 1, frame.index + 12);
  const film = await Promise.all(Array.from({ length: last - first + 1 }, (_, k) => picture(first + k)));
  let at = 0;
  timer = setInterval(() => {
    if (at >= film.length) return show(frame.index).catch(fail);
    displayed = film[at];
    shown = first + at++;
    mark();
    draw();
  }, 80);
}

function report() {
  $("which").textContent = `${overview.capture}, ${overview.instrument}`;
  $("bar").style.width = `${Math.min(100, 100 * overview.done / overview.of)}%`;
  $("count").textContent = overview.done >= overview.of ? `${overview.done} frames posed: enough; more still help` : `${overview.done} of ${overview.of} suggested frames posed`;
  const rows = [];
  for (const [name, [half, most]] of Object.entries(overview.sure)) {
    const term = document.createElement("dt"), text = document.createElement("dd");
    term.textContent = name;
    text.textContent = half >= 179 ? "not known yet" : `± ${Math.round(half)}°, at worst ± ${Math.round(most)}°`;
    rows.push(term, text);
  }
  $("sure").replaceChildren(...rows);
  $("answers").replaceChildren(...overview.answered.map(item => {
    const row = document.createElement("li");
    const joints = Object.entries(item.joints).map(([name, value]) => `, ${name} ${Math.round(value)}°`).join("");
    row.textContent = `${item.name}: roll ${Math.round(item.roll)}°${joints}` + item.doubts.map(warning => `; ${warning}`).join("");
    row.className = item.doubts.length ? "doubted" : "";
    row.onclick = () => go(item.frame, "posed before").catch(fail);
    return row;
  }));
  $("undo").disabled = !overview.answered.length;
}

async function act(work) {
  if (busy) return;
  busy = true;
  $("save").disabled = true;
  try { await work(); } catch (error) { fail(error); }
  busy = false;
  $("save").disabled = false;
}

const save = () => act(async () => {
  say("saving");
  const name = frame.name;
  overview = await ask("save", { index: frame.index, ...pose });
  skipped.clear();
  report();
  say(overview.said.length ? `${name} is saved, but its ${overview.said.join("; ")}. Undo to look again.` : `${name} is saved.`, overview.said.length);
  await next();
});

const skip = () => act(async () => {
  skipped.add(frame.index);
  say("skipped");
  await next();
});

const undo = () => act(async () => {
  overview = await ask("undo");
  report();
  if (overview.frame === null) return;
  say("the last answer is gone");
  await go(overview.frame, "again");
});

function hide() {
  hidden = !hidden;
  $("hide").setAttribute("aria-pressed", hidden);
  draw();
}

function toggleGhost() {
  ghosted = overview.ghost && !ghosted;
  ghost = null;
  $("ghost").setAttribute("aria-pressed", ghosted);
  draw();
  haunt();
}

function say(text, warned) {
  $("said").textContent = text;
  $("said").className = warned ? "doubted" : "";
}

function keep() {
  lines.hinge = Number($("hinge").value);
  lines.share = Number($("share").value);
  $("hinge").ariaValueText = `${lines.hinge.toFixed(1)} mm`;
  $("share").ariaValueText = `${lines.share} percent`;
  $("hinge-value").textContent = lines.hinge.toFixed(1);
  $("share-value").textContent = lines.share;
  localStorage.setItem(`neeco ${overview.capture} ${overview.instrument}`, JSON.stringify(lines));
  if (frame) draw();
}

async function start() {
  overview = await ask("overview");
  const kept = JSON.parse(localStorage.getItem(`neeco ${overview.capture} ${overview.instrument}`) || "{}");
  Object.assign($("hinge"), { max: overview.length, value: kept.hinge ?? HINGE * overview.length });
  $("share").value = kept.share ?? SHARE;
  $("ghost").hidden = !overview.ghost;
  keep();
  report();
  await next();
}

$("save").onclick = save;
$("skip").onclick = skip;
$("undo").onclick = undo;
$("hide").onclick = hide;
$("ghost").onclick = toggleGhost;
$("hinge").oninput = $("share").oninput = keep;
$("canvas").addEventListener("wheel", event => { event.preventDefault(); turn("roll", event.deltaY > 0 ? STEP : -STEP); }, { passive: false });
new ResizeObserver(() => frame && displayed && draw()).observe($("stage"));
addEventListener("keydown", event => {
  if (!frame || event.ctrlKey || event.metaKey || event.altKey) return;
  if (event.target.type === "range" && event.key.startsWith("Arrow")) return;  // the slider's own
  const step = event.shiftKey ? LEAP : STEP;
  const keys = {
    ArrowLeft: () => turn("roll", -step), ArrowRight: () => turn("roll", step),
    ArrowUp: () => turn("joint", step), ArrowDown: () => turn("joint", -step),
    Enter: save, s: skip, u: undo, h: hide, g: toggleGhost, p: () => play().catch(fail),
  };
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (!keys[key] || (key === "Enter" && event.target.tagName === "SUMMARY")) return;
  event.preventDefault();
  keys[key]();
});
start().catch(fail);
