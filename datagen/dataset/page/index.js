"use strict";
// The whole state of the page stands behind the #, so that a view can be kept and sent.
const { clips, tone } = JSON.parse(document.getElementById("data").textContent);
const PAGE = 120, KEPT_CLIPS = 6;
const FILTERS = ["split", "style", "light_family", "contrast"];
const SORTS = { key: "key", style: "style", light_family: "light", contrast_share: "contrast", exposure: "exposure" };
const element = id => document.getElementById(id);
const state = { split: "", style: "", light_family: "", contrast: "", scene: "", sort: "key",
  page: 0, clip: "", frame: 0, stops: 0, curve: "agx", large: "" };
const defaults = { ...state };
const loaded = new Map();  // key -> promise of decoded tiles, the oldest first
const waiting = new Map();  // key -> what takes a clip's tiles when its script runs

// Tone curves: AgX as tables from tron.color, sRGB as in IEC 61966-2-1, both indexed by the base-2 logarithm.
const SAMPLES = tone.agx.length - 1, [LOW, HIGH] = tone.agx_range;
const SRGB = Float32Array.from({ length: SAMPLES + 1 }, (_, k) => {
  const v = Math.min(2 ** (LOW + (HIGH - LOW) * k / SAMPLES), 1);
  return v > 0.0031308 ? 1.055 * v ** (1 / 2.4) - 0.055 : 12.92 * v;
});
function look(table, v) {
  const x = Math.min(Math.max((Math.log2(Math.max(v, 1e-30)) - LOW) / (HIGH - LOW), 0), 1) * SAMPLES;
  const k = Math.min(Math.floor(x), SAMPLES - 1);
  return table[k] + (table[k + 1] - table[k]) * (x - k);
}
function display(r, g, b, curve) {
  if (curve === "srgb") return [look(SRGB, r), look(SRGB, g), look(SRGB, b)];
  return tone.agx_inset.map(m => look(tone.agx, m[0] * r + m[1] * g + m[2] * b));
}

// 12-bit codes -> radiance: datagen/dataset/clip_preview.py wrote them.
const RADIANCE = Float32Array.from({ length: tone.codes + 1 }, (_, code) => code === 0 ? 0 :
  2 ** (tone.log2_range[0] + (tone.log2_range[1] - tone.log2_range[0]) * (code - 1) / (tone.codes - 1)));

async function decode(tile) {
  const image = new Image();
  image.src = tile.png;
  await image.decode();
  const height = tile.light ? image.naturalHeight / 2 : image.naturalHeight, width = image.naturalWidth;
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = image.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const bytes = context.getImageData(0, 0, width, image.naturalHeight).data;
  const values = new Float32Array(3 * width * height), low = 4 * width * height;
  for (let i = 0; i < width * height; i++)
    for (let c = 0; c < 3; c++)
      values[3 * i + c] = tile.light ? RADIANCE[16 * bytes[4 * i + c] + bytes[low + 4 * i + c]] : bytes[4 * i + c] / 255;
  return { ...tile, width, height, values, png: null };
}
function showClip(clip) { waiting.get(clip.key)?.(clip.tiles); }
function load(key) {
  if (!loaded.has(key)) {
    const tiles = new Promise((resolve, reject) => {
      waiting.set(key, resolve);
      const script = document.createElement("script");
      script.src = `previews/${encodeURIComponent(key)}.js`;
      script.onerror = () => reject(new Error(`previews/${key}.js is missing`));
      script.onload = () => script.remove();
      document.head.append(script);
    }).then(found => Promise.all(found.map(decode)));
    tiles.finally(() => waiting.delete(key)).catch(() => loaded.delete(key));
    loaded.set(key, tiles);
    if (loaded.size > KEPT_CLIPS) loaded.delete(loaded.keys().next().value);
  }
  return loaded.get(key);
}

function chosen() {
  const found = clips.filter(clip => FILTERS.every(name => !state[name] || clip[name] === state[name])
    && clip.scene.includes(state.scene.trim()));
  const by = state.sort;
  if (by !== "key") found.sort((a, b) => a[by] < b[by] ? -1 : a[by] > b[by] ? 1 : 0);
  return found;
}
function drawGrid() {
  const found = chosen(), pages = Math.max(Math.ceil(found.length / PAGE), 1);
  state.page = Math.min(Math.max(state.page, 0), pages - 1);
  const shown = found.slice(state.page * PAGE, (state.page + 1) * PAGE);
  element("count").textContent = `${found.length} of ${clips.length} clips`;
  element("place").textContent = `page ${state.page + 1} of ${pages}`;
  element("pages").hidden = pages === 1;
  element("earlier").disabled = state.page === 0;
  element("later").disabled = state.page === pages - 1;
  element("clips").replaceChildren(...shown.map(clip => {
    const item = document.createElement("li"), button = document.createElement("button");
    button.type = "button";
    button.onclick = () => go({ clip: clip.key, frame: 0, large: "" });
    let picture = document.createElement("div");
    picture.className = "none";
    if (clip.thumbnail) {
      picture = document.createElement("img");
      Object.assign(picture, { loading: "lazy", decoding: "async", alt: clip.key, src: clip.thumbnail });
    }
    const name = document.createElement("span"), about = document.createElement("small");
    name.textContent = clip.key;
    about.textContent = `${clip.style} · ${clip.light_family}, ${clip.contrast}`;
    button.append(picture, name, about);
    item.append(button);
    return item;
  }));
}

function paint(canvas, tile, gain) {
  const context = canvas.getContext("2d"), picture = context.createImageData(tile.width, tile.height);
  const v = tile.values;
  for (let i = 0, j = 0; i < v.length; i += 3, j += 4) {
    const rgb = tile.light ? display(gain * v[i], gain * v[i + 1], gain * v[i + 2], state.curve)
      : [v[i], v[i + 1], v[i + 2]];
    for (let c = 0; c < 3; c++) picture.data[j + c] = Math.round(255 * rgb[c]);
    picture.data[j + 3] = 255;
  }
  context.putImageData(picture, 0, 0);
}
function tell(event, tile, canvas) {
  const box = canvas.getBoundingClientRect();
  const scale = Math.min(box.width / tile.width, box.height / tile.height);  // object-fit: contain, at the left
  const x = Math.floor((event.clientX - box.left) / scale);
  const y = Math.floor((event.clientY - box.top - (box.height - scale * tile.height) / 2) / scale);
  if (x < 0 || y < 0 || x >= tile.width || y >= tile.height) return;
  const values = [0, 1, 2].map(c => tile.values[3 * (y * tile.width + x) + c].toPrecision(3));
  element("value").textContent = `${tile.member}, column ${x}, row ${y}: ${values.join("  ")}`
    + (tile.light ? " (linear, before exposure)" : " (as shown)");
}
async function drawViewer() {
  const viewer = element("viewer"), clip = clips.find(each => each.key === state.clip);
  if (!clip) {
    if (viewer.open) viewer.close();
    return;
  }
  if (!viewer.open) viewer.showModal();
  element("name").textContent = clip.key;
  element("about").textContent = `${clip.style}, ${clip.light_family}, ${clip.contrast} contrast, ${clip.frames} frames of `
    + `${clip.width} x ${clip.height}, exposure ${clip.exposure.toPrecision(3)}, in ${clip.shard}`;
  let tiles;
  try { tiles = await load(clip.key); } catch (error) {
    element("tiles").replaceChildren(error.message);
    return;
  }
  if (state.clip !== clip.key) return;  // another was chosen meanwhile
  const film = tiles.filter(tile => tile.member === "rgb");
  state.frame = Math.min(Math.max(state.frame, 0), film.length - 1);
  Object.assign(element("frame"), { max: film.length - 1, value: state.frame });
  element("frame-number").textContent = `${film[state.frame].frame + 1} of ${clip.frames}`;
  Object.assign(element("stops"), { value: state.stops });
  element("stops-number").textContent = `${state.stops > 0 ? "+" : ""}${state.stops} stops`;
  element("curve").value = state.curve;
  const gain = clip.exposure * 2 ** state.stops;
  const shown = [film[state.frame], ...tiles.filter(tile => tile.member !== "rgb")];
  element("tiles").replaceChildren(...shown.map(tile => {
    const figure = document.createElement("figure"), canvas = document.createElement("canvas");
    const caption = document.createElement("figcaption");
    Object.assign(canvas, { width: tile.width, height: tile.height });
    canvas.dataset.member = tile.member;
    canvas.onclick = () => go({ large: state.large === tile.member ? "" : tile.member });
    canvas.onmousemove = event => tell(event, tile, canvas);
    figure.classList.toggle("large", state.large === tile.member);
    caption.textContent = `${tile.member}, frame ${tile.frame + 1}`;
    paint(canvas, tile, gain);
    figure.append(canvas, caption);
    return figure;
  }));
  if (state.large) element("tiles").querySelector("figure.large")?.scrollIntoView({ block: "nearest" });
  document.body.dataset.shown = `${clip.key} ${state.frame} ${state.stops} ${state.curve}`;
}
function step(by) {
  const found = chosen(), here = found.findIndex(clip => clip.key === state.clip);
  const next = found[here + by];
  if (next) go({ clip: next.key, frame: 0 });
}

function go(change) {
  const filtered = [...FILTERS, "scene", "sort"].some(name => name in change);
  Object.assign(state, filtered ? { page: 0 } : {}, change);
  const words = new URLSearchParams();
  for (const [name, value] of Object.entries(state)) if (value !== defaults[name]) words.set(name, value);
  history.replaceState(null, "", words.size ? `#${words}` : location.pathname);
  draw();
}
function read() {
  const words = new URLSearchParams(location.hash.slice(1));
  for (const [name, value] of Object.entries(defaults)) {
    const word = words.get(name);
    state[name] = word === null ? value : typeof value === "number" ? Number(word) || 0 : word;
  }
  if (!(state.sort in SORTS)) state.sort = "key";
  draw();
}
function draw() {
  for (const name of [...FILTERS, "sort", "scene"]) element("filters").elements[name].value = state[name];
  drawGrid();
  drawViewer();
}

for (const name of FILTERS) {
  const values = [...new Set(clips.map(clip => clip[name]))].sort();
  element("filters").elements[name].replaceChildren(new Option("all", ""), ...values.map(v => new Option(v, v)));
  element("filters").elements[name].onchange = event => go({ [name]: event.target.value });
}
element("filters").elements.sort.replaceChildren(...Object.entries(SORTS).map(([value, text]) => new Option(text, value)));
element("filters").elements.sort.onchange = event => go({ sort: event.target.value });
element("filters").elements.scene.oninput = event => go({ scene: event.target.value });
element("filters").onsubmit = event => event.preventDefault();
element("filters").onreset = event => { event.preventDefault(); go({ ...defaults }); };
element("earlier").onclick = () => go({ page: state.page - 1 });
element("later").onclick = () => go({ page: state.page + 1 });
element("frame").oninput = event => go({ frame: Number(event.target.value) });
element("stops").oninput = event => go({ stops: Number(event.target.value) });
element("curve").onchange = event => go({ curve: event.target.value });
element("previous").onclick = () => step(-1);
element("next").onclick = () => step(1);
element("close").onclick = () => go({ clip: "", large: "" });
element("viewer").oncancel = event => { event.preventDefault(); go({ clip: "", large: "" }); };
addEventListener("keydown", event => {
  if (!state.clip || event.target.matches?.("input, select")) return;
  const moves = { ArrowLeft: () => go({ frame: state.frame - 1 }), ArrowRight: () => go({ frame: state.frame + 1 }),
    ArrowUp: () => step(-1), ArrowDown: () => step(1) };
  if (moves[event.key]) { event.preventDefault(); moves[event.key](); }
});
addEventListener("hashchange", read);
read();
