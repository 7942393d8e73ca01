"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const byId = (id) => document.getElementById(id);
const MARGIN = { left: 62, right: 10, top: 12, bottom: 26 };
const hidden = new Set();
let chosen = null, frame = 0, order = data.episodes.slice(), sortedBy = null, descending = false;

function make(tag, attributes, parent, text) {
  const svg = ["svg", "path", "line", "text", "circle"].includes(tag);
  const node = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(attributes || {})) node.setAttribute(key, value);
  if (text !== undefined) node.textContent = text;
  if (parent) parent.append(node);
  return node;
}

function colorOf(name) {
  const color = data.styles[name].color;
  return color === "#000000" ? "var(--text)" : `color-mix(in srgb, ${color}, white var(--lift))`;
}

function strokeOf(name) {
  const { linestyle, linewidth } = data.styles[name], dashes = linestyle === "-" ? [] : linestyle[1];
  return `stroke:${colorOf(name)};stroke-width:${linewidth};stroke-dasharray:${dashes.map((d) => d * linewidth).join(" ") || "none"}`;
}

function number(value, digits = 2) {
  return value === null || value === undefined ? "–" : value.toFixed(digits);
}

// ---- the viewer

function choose(episode) {
  if (!episode) return;
  if (!episode.curves) { location.href = episode.page; return; }
  chosen = episode;
  byId("viewer").hidden = false;
  byId("name").textContent = episode.source;
  byId("facts").textContent = [episode.object, episode.outcome, `${episode.frames} frames at ${Number(episode.fps.toFixed(2))} per second`,
    episode.contact_source === "no touch" ? "" : episode.contact === null ? "no contact found" : `first contact at frame ${episode.contact} (${episode.contact_source})`]
    .filter(Boolean).join(" · ");
  byId("slider").max = episode.frames - 1;
  drawImages();
  drawChart();
  show(episode.frames - 1);
  for (const row of byId("table").tBodies[0].rows) row.classList.toggle("chosen", row.dataset.name === episode.name);
  history.replaceState(null, "", "#" + encodeURIComponent(episode.name));
}

function drawImages() {
  byId("images").replaceChildren();
  for (const [name, sheet] of Object.entries(chosen.sheets)) {
    const figure = make("figure", {}, byId("images"));
    const scale = scaleOf(sheet), image = make("div", { "data-sheet": name }, figure);
    image.style.cssText = `width:${sheet.width * scale}px;height:${sheet.height * scale}px;background-image:url(${sheet.uri});` +
      `background-size:${sheet.columns * sheet.width * scale}px auto`;
    make("figcaption", {}, figure, name.replace("_", " "));
  }
}

const scaleOf = (sheet) => Math.min(168 / sheet.height, byId("images").clientWidth / sheet.width);

function place(div, sheet, k, scale) {
  const x = (k % sheet.columns) * sheet.width * scale, y = Math.floor(k / sheet.columns) * sheet.height * scale;
  div.style.backgroundPosition = `-${x}px -${y}px`;
}

function nearest(frames, wanted) {
  let best = 0;
  frames.forEach((f, k) => { if (Math.abs(f - wanted) < Math.abs(frames[best] - wanted)) best = k; });
  return best;
}

function scales() {
  const box = byId("chart").getBoundingClientRect(), width = box.width || 800, height = box.height || 300;
  const shown = data.curves.filter((n) => chosen.curves[n] && !hidden.has(n));
  const values = shown.flatMap((n) => chosen.curves[n]);
  let low = Math.min(0, ...values.slice(0, 1)), high = data.levels.length ? 1.1 : 0.01;
  for (const v of values) { low = Math.min(low, v); high = Math.max(high, v); }
  high += 0.04 * (high - low);
  const end = Math.max(chosen.frames - 1, 1);
  return {
    width, height, shown, low, high,
    x: (f) => MARGIN.left + (f / end) * (width - MARGIN.left - MARGIN.right),
    y: (v) => height - MARGIN.bottom - ((v - low) / (high - low)) * (height - MARGIN.top - MARGIN.bottom),
    frame: (px) => Math.round(((px - MARGIN.left) / (width - MARGIN.left - MARGIN.right)) * end),
  };
}

function steps(low, high, count) {
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw), ticks = [];
  for (let v = Math.ceil(low / step) * step; v <= high; v += step) ticks.push(Number(v.toPrecision(10)));
  return ticks;
}

function drawChart() {
  const chart = byId("chart"), s = scales();
  chart.replaceChildren();
  chart.setAttribute("viewBox", `0 0 ${s.width} ${s.height}`);
  for (const v of steps(s.low, s.high, 5)) {
    make("line", { class: "grid", x1: MARGIN.left, x2: s.width - MARGIN.right, y1: s.y(v), y2: s.y(v) }, chart);
    make("text", { x: MARGIN.left - 7, y: s.y(v) + 4, "text-anchor": "end" }, chart, String(v));
  }
  const middle = (s.height - MARGIN.bottom + MARGIN.top) / 2;
  make("text", { x: 12, y: middle, transform: `rotate(-90 12 ${middle})`, "text-anchor": "middle" }, chart, data.unit);
  const seconds = (chosen.frames - 1) / chosen.fps;
  for (const t of steps(0, seconds, Math.min(8, s.width / 80))) {
    make("text", { x: s.x(t * chosen.fps), y: s.height - 8, "text-anchor": "middle" }, chart, `${t} s`);
  }
  for (const [level, label] of data.levels) {
    const atEnd = level > 0;
    make("line", { class: "level", x1: MARGIN.left, x2: s.width - MARGIN.right, y1: s.y(level), y2: s.y(level) }, chart);
    make("text", { x: atEnd ? s.width - MARGIN.right - 4 : MARGIN.left + 5, y: s.y(level) - 5, "text-anchor": atEnd ? "end" : "start" }, chart, label);
  }
  if (chosen.contact !== null) {
    const x = s.x(chosen.contact), right = chosen.contact > 0.85 * chosen.frames;
    make("line", { class: "contact", x1: x, x2: x, y1: MARGIN.top, y2: s.height - MARGIN.bottom }, chart);
    make("text", { x: x + (right ? -5 : 5), y: MARGIN.top + 9, "text-anchor": right ? "end" : "start" }, chart, "contact");
  }
  for (const name of s.shown) {
    const curve = chosen.curves[name];
    const d = curve.map((v, k) => `${k ? "L" : "M"}${s.x(chosen.at[k]).toFixed(1)} ${s.y(v).toFixed(1)}`).join("");
    make("path", { d, style: strokeOf(name) }, chart);
    for (const peak of (name === byId("curve").value && chosen.peaks[name]) || []) {
      const x = s.x(peak), y = s.y(curve[nearest(chosen.at, peak)]) - 4;
      make("path", { d: `M${x} ${y}l-4.5 -7h9z`, class: "peak", style: `fill:${colorOf(name)};stroke:none` }, chart);
    }
  }
  drawLegend();
}

function drawLegend() {
  byId("legend").replaceChildren();
  for (const name of data.curves) {
    if (!chosen.curves[name]) continue;
    const item = make("li", { class: (name === data.main ? "main " : "") + (hidden.has(name) ? "off" : "") }, byId("legend"));
    make("line", { x1: 0, x2: 26, y1: 3, y2: 3, style: strokeOf(name) }, make("svg", { width: 26, height: 6 }, item));
    make("span", {}, item, name);
    make("b", { "data-curve": name }, item);
    item.onclick = () => {
      if (!hidden.delete(name)) hidden.add(name);
      drawChart();
      show(frame);
    };
  }
}

function show(wanted) {
  frame = Math.min(Math.max(wanted, 0), chosen.frames - 1);
  byId("slider").value = frame;
  byId("time").textContent = `${(frame / chosen.fps).toFixed(2)} s, frame ${frame}`;
  const k = nearest(chosen.shown, frame), point = nearest(chosen.at, frame);
  for (const div of byId("images").querySelectorAll("[data-sheet]")) {
    const sheet = chosen.sheets[div.dataset.sheet];
    place(div, sheet, k, scaleOf(sheet));
  }
  const chart = byId("chart"), s = scales();
  chart.querySelectorAll(".cursor").forEach((node) => node.remove());
  make("line", { class: "cursor", x1: s.x(frame), x2: s.x(frame), y1: MARGIN.top, y2: s.height - MARGIN.bottom }, chart);
  for (const name of s.shown) {
    make("circle", { class: "cursor", cx: s.x(frame), cy: s.y(chosen.curves[name][point]), r: 3.5, style: `fill:${colorOf(name)};stroke:none` }, chart);
  }
  for (const cell of byId("legend").querySelectorAll("[data-curve]")) {
    cell.textContent = number(chosen.curves[cell.dataset.curve][point]);
  }
}

// ---- the table

const valueOf = (episode, column) => column.metric ? (episode.metrics[byId("curve").value] || {})[column.key] : episode[column.key];

function drawTable() {
  const table = byId("table");
  table.tHead.replaceChildren();
  const head = make("tr", {}, table.tHead);
  make("th", {}, head);
  for (const column of data.columns) {
    const cell = make("th", { scope: "col", title: column.meaning || "", class: column.word ? "word" : "" }, head, column.label);
    if (sortedBy === column) cell.setAttribute("aria-sort", descending ? "descending" : "ascending");
    cell.onclick = () => {
      descending = sortedBy === column && !descending;
      sortedBy = column;
      sortRows();
      drawTable();
    };
  }
  table.tBodies[0].replaceChildren();
  for (const episode of order) {
    const row = make("tr", { "data-name": episode.name, class: episode === chosen ? "chosen" : "" }, table.tBodies[0]);
    const thumb = make("div", { class: "thumb" }, make("td", {}, row));
    drawThumb(thumb, episode);
    for (const column of data.columns) make("td", { class: column.word ? "word" : "" }, row, cellText(episode, column));
    row.onclick = () => { choose(episode); byId("viewer").scrollIntoView({ block: "nearest" }); };
  }
}

function cellText(episode, column) {
  const value = valueOf(episode, column);
  return column.word ? value || "" : number(value, column.digits);
}

function drawThumb(thumb, episode) {
  if (episode.thumb) {
    thumb.style.cssText = `background:url(${episode.thumb}) center/cover`;
    return;
  }
  const sheet = Object.values(episode.sheets || {})[0];
  if (!sheet) return;
  const scale = 48 / sheet.width;
  thumb.style.cssText = `height:${sheet.height * scale}px;background-image:url(${sheet.uri});background-size:${48 * sheet.columns}px auto`;
  place(thumb, sheet, episode.shown.length - 1, scale);
}

function sortRows() {
  if (!sortedBy) return;
  const rank = (e) => { const v = valueOf(e, sortedBy); return v === undefined || v === "" ? null : v; };
  order.sort((a, b) => {
    const x = rank(a), y = rank(b);
    if (x === null || y === null) return (x === null) - (y === null);
    const sign = typeof x === "string" ? x.localeCompare(y, undefined, { numeric: true }) : x - y;
    return descending ? -sign : sign;
  });
}

// ---- events

for (const name of data.curves) make("option", { value: name }, byId("curve"), name);
byId("curve").value = data.main;
byId("curve").onchange = () => {
  hidden.delete(byId("curve").value);
  sortRows();
  drawTable();
  if (chosen) { drawChart(); show(frame); }
};
for (const column of data.columns) {
  if (!column.meaning) continue;
  make("dt", {}, byId("meanings"), column.label);
  make("dd", {}, byId("meanings"), column.meaning);
}
byId("slider").oninput = (event) => show(Number(event.target.value));
const scrub = (event) => {
  if (!chosen) return;
  show(scales().frame(event.clientX - byId("chart").getBoundingClientRect().left));
};
byId("chart").onpointermove = scrub;
byId("chart").onpointerdown = scrub;
document.onkeydown = (event) => {
  if (!chosen || event.target.tagName === "SELECT") return;
  const along = { ArrowLeft: -1, ArrowRight: 1 }[event.key], between = { ArrowUp: -1, ArrowDown: 1 }[event.key];
  if (along) show(frame + along * (event.shiftKey ? 10 : 1));
  else if (between) choose(order[order.indexOf(chosen) + between]);
  else return;
  event.preventDefault();
};
window.onresize = () => { if (chosen) { drawImages(); drawChart(); show(frame); } };
drawTable();
const named = decodeURIComponent(location.hash.slice(1));
const first = data.episodes.find((e) => e.name === named) || data.episodes[0];
if (first && first.curves) choose(first);
