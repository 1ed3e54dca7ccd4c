"use strict";
// Draws the splats of one moment far to near, each as a quad with a Gaussian in it.
// World and camera axes are those of the program: x right, y down, z forward, metres.

const scene = JSON.parse(document.getElementById("scene").textContent);
const element = (name) => document.getElementById(name);
const canvas = element("view");

const VERTEX = `#version 300 es
precision highp float;
uniform mat4 camera_from_world;  // column by column
uniform vec2 focal, principal, size;  // [px] of the canvas
uniform float low_pass;  // [px^2]
uniform vec3 measured_from;  // the sequence's camera, in the world [m]
uniform vec2 range;  // distances of the first and the last colour [m]
uniform bool by_distance;
uniform sampler2D ramp;
in vec2 corner;  // of the quad, -1 .. 1
in vec3 centre;  // in the world [m]
in vec3 diagonal, beside;  // covariance: xx, yy, zz; xy, xz, yz [m^2]
in vec4 rgba;
out vec2 offset;  // in standard deviations
out vec4 colour;

void main() {
  vec3 p = (camera_from_world * vec4(centre, 1.0)).xyz;
  mat3 spread = mat3(diagonal.x, beside.x, beside.y, beside.x, diagonal.y, beside.z,
                     beside.y, beside.z, diagonal.z);
  vec2 slope = clamp(p.xy / p.z, -1.3 * 0.5 * size / focal, 1.3 * 0.5 * size / focal);
  vec3 across = vec3(focal.x / p.z, 0.0, -focal.x * slope.x / p.z);
  vec3 down = vec3(0.0, focal.y / p.z, -focal.y * slope.y / p.z);
  mat3 turn = mat3(camera_from_world);
  vec3 a = across * turn, b = down * turn;
  float xx = dot(a, spread * a) + low_pass, yy = dot(b, spread * b) + low_pass;
  float xy = dot(a, spread * b);
  float half_sum = 0.5 * (xx + yy), apart = length(vec2(0.5 * (xx - yy), xy));
  float angle = 0.5 * atan(2.0 * xy, xx - yy);
  vec2 axis = vec2(cos(angle), sin(angle));
  float reach = sqrt(max(0.0, 2.0 * log(255.0 * rgba.a)));  // where alpha is 1/255
  offset = corner * reach;
  vec2 deviation = sqrt(vec2(half_sum + apart, max(half_sum - apart, 0.0)));
  vec2 at = focal * p.xy / p.z + principal
    + offset.x * deviation.x * axis + offset.y * deviation.y * vec2(-axis.y, axis.x);
  gl_Position = p.z < 0.02 ? vec4(0.0, 0.0, 2.0, 1.0)
    : vec4(2.0 * at.x / size.x - 1.0, 1.0 - 2.0 * at.y / size.y, 0.0, 1.0);
  float share = (distance(centre, measured_from) - range.x) / (range.y - range.x);
  vec3 shown = by_distance ? texture(ramp, vec2(clamp(share, 0.002, 0.998), 0.5)).rgb : rgba.rgb;
  colour = vec4(shown, rgba.a);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
in vec4 colour;
out vec4 pixel;

void main() {
  float alpha = min(0.99, colour.a * exp(-0.5 * dot(offset, offset)));
  if (alpha < 1.0 / 255.0) discard;
  pixel = vec4(colour.rgb * alpha, alpha);
}`;

// --- the arrays, as scene_arrays.py lists them

function arrays() {
  const text = atob(scene.arrays), bytes = new Uint8Array(text.length);
  for (let k = 0; k < text.length; k++) bytes[k] = text.charCodeAt(k);
  let at = 0;
  const next = (kind, length) => {
    const found = new kind(bytes.buffer, at, length);
    at += found.byteLength;
    return found;
  };
  const { count, resting } = scene, moved = scene.moving.reduce((a, b) => a + b, 0);
  return {
    index: next(Uint32Array, moved), scale: next(Uint16Array, 3 * count),
    still: next(Uint16Array, 3 * resting), place: next(Uint16Array, 3 * moved),
    colour: next(Uint8Array, 4 * count),
    stillTurn: next(Int8Array, 4 * resting), turn: next(Int8Array, 4 * moved),
  };
}

const data = arrays();
const starts = scene.moving.reduce((all, n) => [...all, all[all.length - 1] + n], [0]);
const FLOATS = 13; // of a splat: centre, covariance, colour and opacity
const most = scene.resting + Math.max(...scene.moving);
const splats = new Float32Array(FLOATS * most), sorted = new Float32Array(FLOATS * most);

// Fill row `row` of splats with Gaussian `n`, whose place and turn are row `from` of the other arrays.
function fill(row, n, places, turns, from) {
  const at = FLOATS * row, v = [], { place, scale } = scene;
  for (let k = 0; k < 3; k++) {
    splats[at + k] = place.low[k] + place.step[k] * places[3 * from + k];
    v.push(Math.exp(2 * (scale.low[k] + scale.step[k] * data.scale[3 * n + k]))); // variances
  }
  const length = Math.hypot(...turns.subarray(4 * from, 4 * from + 4)) || 1;
  const [w, x, y, z] = Array.from(turns.subarray(4 * from, 4 * from + 4), (q) => q / length);
  const r = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
  const entry = (i, j) => r[i][0] * v[0] * r[j][0] + r[i][1] * v[1] * r[j][1] + r[i][2] * v[2] * r[j][2];
  splats.set([entry(0, 0), entry(1, 1), entry(2, 2), entry(0, 1), entry(0, 2), entry(1, 2)], at + 3);
  for (let k = 0; k < 4; k++) splats[at + 9 + k] = data.colour[4 * n + k] / 255;
}

let shownCount = 0, moment = -1;
for (let n = 0; n < scene.resting; n++) fill(n, n, data.still, data.stillTurn, n);

function show(index) {
  moment = index;
  const first = starts[index], count = scene.moving[index];
  for (let m = 0; m < count; m++) {
    fill(scene.resting + m, data.index[first + m], data.place, data.turn, first + m);
  }
  shownCount = scene.resting + count;
  const frame = scene.frames[index];
  const named = frame === null ? "" : `, raw frame ${frame}`;
  element("now").textContent = `${scene.times[index].toFixed(4)} s${named}`;
  element("time").value = index;
}

// Copy splats to `sorted`, far to near, by their z-depth in 65536 steps.
const keys = new Uint16Array(most), depths = new Float32Array(most), slots = new Uint32Array(65537);
function sort(view) {
  let low = Infinity, high = -Infinity;
  for (let n = 0; n < shownCount; n++) {
    const at = FLOATS * n;
    const z = view[8] * splats[at] + view[9] * splats[at + 1] + view[10] * splats[at + 2] + view[11];
    depths[n] = z;
    if (z < low) low = z;
    if (z > high) high = z;
  }
  slots.fill(0);
  for (let n = 0; n < shownCount; n++) {
    keys[n] = 65535 * (high - depths[n]) / (high - low || 1);
    slots[keys[n] + 1]++;
  }
  for (let k = 0; k < 65536; k++) slots[k + 1] += slots[k];
  for (let n = 0; n < shownCount; n++) {
    sorted.set(splats.subarray(FLOATS * n, FLOATS * (n + 1)), FLOATS * slots[keys[n]]++);
  }
}

// --- the view: a camera that turns about a pivot; `shift` is where the pivot is in camera axes

const turnOf = (view) => [view.slice(0, 3), view.slice(4, 7), view.slice(8, 11)];
const apply = (a, v) => a.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
const transposed = (a) => [0, 1, 2].map((j) => a.map((row) => row[j]));
const product = (a, b) => transposed(transposed(b).map((column) => apply(a, column)));
function centreOf(view) { // of a camera, in the world
  return apply(transposed(turnOf(view)), [-view[3], -view[7], -view[11]]);
}
let turn, shift;

function lookFrom(view) { // row by row, camera from world
  turn = turnOf(view);
  shift = apply(turn, scene.pivot).map((value, k) => value + view[4 * k + 3]);
}

function currentView() {
  const moved = apply(turn, scene.pivot);
  return turn.flatMap((row, k) => [...row, shift[k] - moved[k]]).concat([0, 0, 0, 1]);
}

function turnBy(right, down) { // radians, about the camera's own axes through the pivot
  const [c, s, d, t] = [Math.cos(right), Math.sin(right), Math.cos(down), Math.sin(down)];
  const across = [[c, 0, s], [0, 1, 0], [-s, 0, c]], over = [[1, 0, 0], [0, d, t], [0, -t, d]];
  turn = product(product(over, across), turn);
}

// --- WebGL

const gl = canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
if (!gl) {
  element("problem").hidden = false;
  element("problem").textContent = "This page needs WebGL 2, which this browser or machine does not offer.";
  throw new Error("no WebGL 2");
}

function compiled(kind, text) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, text);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
  return shader;
}

const program = gl.createProgram();
gl.attachShader(program, compiled(gl.VERTEX_SHADER, VERTEX));
gl.attachShader(program, compiled(gl.FRAGMENT_SHADER, FRAGMENT));
gl.linkProgram(program);
gl.useProgram(program);
const uniform = (name) => gl.getUniformLocation(program, name);

function attribute(name, size, stride, at, each) {
  const where = gl.getAttribLocation(program, name);
  gl.enableVertexAttribArray(where);
  gl.vertexAttribPointer(where, size, gl.FLOAT, false, 4 * stride, 4 * at);
  gl.vertexAttribDivisor(where, each);
}

gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
attribute("corner", 2, 2, 0, 0);
gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
gl.bufferData(gl.ARRAY_BUFFER, sorted.byteLength, gl.DYNAMIC_DRAW);
attribute("centre", 3, FLOATS, 0, 1);
attribute("diagonal", 3, FLOATS, 3, 1);
attribute("beside", 3, FLOATS, 6, 1);
attribute("rgba", 4, FLOATS, 9, 1);
gl.enable(gl.BLEND);
gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
gl.clearColor(0.047, 0.059, 0.075, 1);
const ramp = Uint8Array.from(scene.viridis.flatMap((rgb) => [...rgb, 255]));
gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, scene.viridis.length, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, ramp);
gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);

let wanted = false;
function draw() { // at the next repaint
  if (!wanted) requestAnimationFrame(drawNow);
  wanted = true;
}

function drawNow() {
  wanted = false;
  const ratio = Math.min(devicePixelRatio || 1, 2), camera = scene.camera;
  const width = Math.round(ratio * canvas.clientWidth), height = Math.round(ratio * canvas.clientHeight);
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
  if (element("follow").checked) lookFrom(scene.views[moment]);
  const view = currentView();
  sort(view);
  gl.bufferSubData(gl.ARRAY_BUFFER, 0, sorted.subarray(0, FLOATS * shownCount));
  const free = height - ratio * (document.querySelector("footer").offsetHeight + 36); // above the controls
  const zoom = Math.min(width / camera.width, free / camera.height); // the sequence's whole image fits
  const corner = [0.5 * (width - zoom * camera.width), ratio * 36 + 0.5 * (free - zoom * camera.height)];
  gl.viewport(0, 0, width, height);
  gl.uniformMatrix4fv(uniform("camera_from_world"), true, view);
  gl.uniform2f(uniform("focal"), zoom * camera.fx, zoom * camera.fy);
  gl.uniform2f(uniform("principal"), corner[0] + zoom * camera.cx, corner[1] + zoom * camera.cy);
  gl.uniform2f(uniform("size"), width, height);
  gl.uniform1f(uniform("low_pass"), scene.low_pass * zoom * zoom); // as wide as in the sequence's image
  gl.uniform3f(uniform("measured_from"), ...centreOf(scene.views[moment]));
  gl.uniform2f(uniform("range"), ...range);
  gl.uniform1i(uniform("by_distance"), Number(element("colour").value));
  gl.clear(gl.COLOR_BUFFER_BIT);
  gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, shownCount);
}

// --- controls

function distances() { // percentiles 1 and 99 of the splats' distances from the first camera
  const found = [], eye = centreOf(scene.views[0]);
  for (let n = 0; n < shownCount; n++) {
    if (splats[FLOATS * n + 12] < 0.3) continue;
    found.push(Math.hypot(...eye.map((value, k) => splats[FLOATS * n + k] - value)));
  }
  found.sort((a, b) => a - b);
  const at = (share) => found.length ? found[Math.floor(share * (found.length - 1))] : 1;
  return [at(0.01), Math.max(at(0.99), at(0.01) + 0.01)];
}

function byDistance() {
  element("bar").hidden = element("colour").value !== "1";
  draw();
}

let playing = null;
function play() {
  element("play").textContent = playing ? "▶" : "❚❚";
  if (playing) {
    clearInterval(playing);
    playing = null;
    return;
  }
  const rate = Math.min(30, Math.max(4, scene.times.length / 5)); // as the program's videos
  playing = setInterval(() => { show((moment + 1) % scene.times.length); draw(); }, 1000 / rate);
}

const pointers = new Map();
canvas.addEventListener("pointerdown", (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.clientX, event.clientY]);
});
for (const end of ["pointerup", "pointercancel"]) {
  canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
}
canvas.addEventListener("pointermove", (event) => {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = [event.clientX, event.clientY], [dx, dy] = [now[0] - before[0], now[1] - before[1]];
  element("follow").checked = false;
  const size = Math.max(canvas.clientWidth, canvas.clientHeight);
  if (pointers.size === 2) {
    const other = [...pointers].find(([name]) => name !== event.pointerId)[1];
    const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
    shift[2] *= apart(before) / apart(now);
    shift = [shift[0] + 0.5 * dx / size * shift[2], shift[1] + 0.5 * dy / size * shift[2], shift[2]];
  } else if (event.buttons & 6) {
    shift = [shift[0] + dx / size * shift[2], shift[1] + dy / size * shift[2], shift[2]];
  } else {
    turnBy(-4 * dx / size, -4 * dy / size); // what is near follows the pointer
  }
  pointers.set(event.pointerId, now);
  draw();
});
canvas.addEventListener("contextmenu", (event) => event.preventDefault());
canvas.addEventListener("wheel", (event) => {
  event.preventDefault();
  element("follow").checked = false;
  shift[2] *= Math.exp(0.001 * event.deltaY);
  draw();
}, { passive: false });
addEventListener("keydown", (event) => {
  if (event.key === " " && event.target.tagName !== "BUTTON") { event.preventDefault(); play(); }
});
addEventListener("resize", draw);
element("time").max = scene.times.length - 1;
element("time").addEventListener("input", (event) => { show(Number(event.target.value)); draw(); });
element("play").addEventListener("click", play);
element("follow").addEventListener("change", draw);
element("colour").addEventListener("change", byDistance);
element("reset").addEventListener("click", () => { lookFrom(scene.views[moment]); draw(); });

function open() { // #3 opens the page at moment 3, #3,distance coloured by distance
  const [start, colour] = location.hash.slice(1).split(",");
  show(Math.min(Math.max(Number.parseInt(start, 10) || 0, 0), scene.times.length - 1));
  element("colour").value = colour === "distance" ? "1" : "0";
  byDistance();
}

element("colour").options[0].textContent = scene.shown;
element("about").textContent = `${scene.count} Gaussians, ${scene.times.length} moments`;
show(0);
lookFrom(scene.views[0]);
const range = distances();
[element("near").textContent, element("far").textContent] = [range[0].toFixed(2), `${range[1].toFixed(2)} m`];
element("ramp").width = scene.viridis.length;
const picture = new ImageData(Uint8ClampedArray.from(ramp), scene.viridis.length);
element("ramp").getContext("2d").putImageData(picture, 0, 0);
addEventListener("hashchange", open);
open();
