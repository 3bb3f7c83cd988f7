"""The page around the figures: HTML, style for screen, phone and paper, and the script of the common cursor."""

STYLE = """
:root { --ink: #1f2933; --soft: #52606d; --line: #e4e7eb; --back: #f5f7fa; --good: #009E73; --caution: #E69F00;
  --bad: #D55E00; }
* { box-sizing: border-box; }
html, body { overflow-x: clip; }
body { margin: 0; background: var(--back); color: var(--ink);
  font: 15px/1.45 system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif; }
header, .summary, section, .mapcard { background: #fff; border: 1px solid var(--line); border-radius: 10px;
  padding: 16px 20px; margin: 12px; }
header { display: flex; flex-wrap: wrap; align-items: baseline; gap: 4px 18px; }
h1 { font-size: 22px; margin: 0; overflow-wrap: anywhere; } h2 { font-size: 17px; margin: 0 0 8px; }
header p, p { color: var(--soft); margin: 4px 0 10px; max-width: 80em; } header p { margin: 0; }
.verdict { display: flex; align-items: center; gap: 12px; font-size: 20px; padding: 12px 16px; border-radius: 8px;
  color: var(--ink); border-left: 8px solid; }
.verdict.good { border-color: var(--good); background: #e5f5f0; }
.verdict.caution { border-color: var(--caution); background: #fdf5e3; }
.verdict.bad { border-color: var(--bad); background: #fbeae0; }
.sign { flex: none; display: inline-flex; width: 1.45em; height: 1.45em; border-radius: 50%; color: #fff;
  align-items: center; justify-content: center; font-weight: 700; }
.good > .sign { background: var(--good); } .caution > .sign { background: #b87e00; } .bad > .sign {
  background: var(--bad); }
.findings { list-style: none; margin: 12px 0; padding: 0; }
.findings li { display: flex; gap: 10px; padding: 5px 0; } .findings .sign { font-size: 12px; margin-top: 3px; }
.findings em { color: var(--soft); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(140px, 1fr)); gap: 10px; margin: 12px 0; }
.tiles div { background: var(--back); border-radius: 8px; padding: 10px 12px; }
.tiles b { display: block; font-size: 22px; font-weight: 650; } .tiles span { color: var(--soft); font-size: 13px; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; margin: 4px 0 10px; }
th, td { padding: 4px 9px 4px 0; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { color: var(--soft); font-weight: 600; } th:first-child, td:first-child { text-align: left; }
th:last-child, td:last-child { padding-right: 0; }
.summary td:last-child, .summary th:last-child { text-align: left; white-space: normal; }
.note { font-size: 13px; margin: 2px 0; } .bad-note, p.bad { color: var(--bad); }
nav { position: sticky; top: 0; z-index: 20; background: var(--back); padding: 8px 12px;
  border-bottom: 1px solid var(--line); overflow-x: auto; white-space: nowrap; }
nav a { color: #0b5d91; text-decoration: none; padding: 4px 10px; font-size: 14px; }
nav a:hover { text-decoration: underline; }
main { display: grid; grid-template-columns: minmax(0, 1fr); } main > div { min-width: 0; }
.mapcard .plot { height: 62vh; min-height: 340px; } .mapcard .plot > div { height: 100%; }
.player { display: flex; align-items: center; gap: 10px; flex-wrap: wrap; }
.player button { border: 1px solid var(--line); background: #fff; border-radius: 50%; width: 36px; height: 36px;
  font-size: 14px; cursor: pointer; } .player input { flex: 1; min-width: 120px; accent-color: #0072B2; }
.player output { flex-basis: 100%; font-size: 13px; color: var(--soft); font-variant-numeric: tabular-nums;
  min-height: 1.5em; }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 360px), 1fr)); gap: 14px 18px; }
figure { margin: 0; min-width: 0; } section { scroll-margin-top: 52px; min-width: 0; }
figure.wide { grid-column: 1 / -1; }
figcaption { font-size: 12.5px; color: var(--soft); padding: 2px 8px; }
footer { color: var(--soft); font-size: 13px; padding: 4px 32px 24px; }
@media (min-width: 1200px) {
  .tiles { grid-template-columns: repeat(3, 1fr); }
  .two { display: grid; grid-template-columns: minmax(0, 1fr) minmax(0, 1fr); gap: 32px; margin-top: 12px; }
  main { grid-template-columns: minmax(0, 2fr) minmax(0, 3fr); align-items: start; }
  .mapcard { position: sticky; top: 52px; margin-right: 0; } .mapcard .plot { height: min(calc(100vh - 200px), 44vw); }
}
@media (max-width: 600px) {
  .summary td:last-child { min-width: 13em; }
  header, .summary, section, .mapcard { margin: 8px 6px; padding: 12px 10px; }
  .verdict { font-size: 17px; padding: 10px 12px; } .mapcard .plot { height: 105vw; } footer { padding: 4px 16px 20px; }
  .tiles { grid-template-columns: 1fr 1fr; }
}
@media print {
  @page { size: A4; margin: 12mm; }
  body { background: #fff; font-size: 11px; } nav, .player, #motion, #measurements, #timing { display: none; }
  header, .summary, section, .mapcard { border: 0; margin: 0; padding: 4px 0; }
  main { display: block; } .mapcard { position: static; break-inside: avoid; } .mapcard .plot { height: 110mm; }
  .panels { display: block; columns: 2; column-gap: 6mm; } figure { break-inside: avoid; } h2 { break-after: avoid; }
  .verdict, .sign, .tiles div { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""

SCRIPT = """
(function () {
  'use strict';
  let plots = [], track = null, marker = null, wanted = null, drawn = null, playing = 0;
  const slider = document.getElementById('time'), now = document.getElementById('now');
  const button = document.getElementById('play');
  if (!slider) return;
  function place(t) {
    const times = track.data.t;
    let low = 0, high = times.length - 1;
    while (high - low > 1) {
      const middle = (low + high) >> 1;
      if (times[middle] <= t) low = middle; else high = middle;
    }
    const span = times[high] - times[low];
    return [low, high, span > 0 ? Math.min(1, Math.max(0, (t - times[low]) / span)) : 0];
  }
  function isSeen(plot) {
    // The holder itself has no box (display: contents).
    const box = plot.holder.firstElementChild.getBoundingClientRect();
    return box.bottom > 0 && box.top < window.innerHeight;
  }
  function draw() {
    drawn = null;
    const t = wanted, [low, high, share] = place(t);
    const at = name => track.data[name][low] * (1 - share) + track.data[name][high] * share;
    marker.data = {x: [at('x')], y: [at('y')]};
    for (const plot of plots) if (isSeen(plot)) { plot.span.visible = true; plot.span.location = t; }
    now.textContent = t.toFixed(1) + ' s · ' + at('speed').toFixed(1) + ' m/s · sigma ' + at('sigma').toFixed(2) +
      ' m · east ' + at('x').toFixed(1) + ', north ' + at('y').toFixed(1) + ', up ' + at('z').toFixed(1) + ' m';
    slider.value = t;
  }
  function goTo(t) {
    if (track === null || !isFinite(t)) return;
    wanted = Math.min(track.data.t[track.data.t.length - 1], Math.max(track.data.t[0], t));
    if (drawn === null) drawn = requestAnimationFrame(draw);
  }
  function goToPlace(x, y) {
    if (track === null || playing) return;
    const xs = track.data.x, ys = track.data.y;
    let best = 0, least = Infinity;
    for (let i = 0; i < xs.length; i++) {
      const distance = (xs[i] - x) ** 2 + (ys[i] - y) ** 2;
      if (distance < least) { least = distance; best = i; }
    }
    goTo(track.data.t[best]);
  }
  function step() {
    const times = track.data.t, last = times[times.length - 1];
    // The whole recording in half a minute, but no faster than it was where it is short.
    const next = (wanted === null ? times[0] : wanted) + Math.max(0.05, (last - times[0]) / 600);
    goTo(next);
    if (next >= last) toggle();
  }
  function toggle() {
    if (playing) { clearInterval(playing); playing = 0; button.textContent = '\\u25B6'; return; }
    if (wanted !== null && wanted >= track.data.t[track.data.t.length - 1]) wanted = track.data.t[0];
    playing = setInterval(step, 50);
    button.textContent = '\\u23F8';
  }
  function start() {
    const page = Bokeh.documents[0];
    if (!page || !page.get_model_by_name('track')) { setTimeout(start, 100); return; }
    track = page.get_model_by_name('track'); marker = page.get_model_by_name('marker');
    const coarse = window.matchMedia('(pointer: coarse)').matches;
    for (const holder of document.querySelectorAll('[data-root-id]')) {
      const plot = page.get_model_by_id(holder.dataset.rootId);
      // A finger on a plot scrolls the page; the tools can be switched on.
      if (plot && coarse) for (const tool of plot.toolbar.tools) if (tool.active === true) tool.active = false;
      const span = plot && plot.center.find(model => model.name === 'cursor');
      if (span) plots.push({holder, span});
    }
    const times = track.data.t;
    slider.min = times[0]; slider.max = times[times.length - 1]; slider.step = 'any'; slider.value = times[0];
    slider.addEventListener('input', () => goTo(Number(slider.value)));
    button.addEventListener('click', toggle);
    goTo(times[0]);
  }
  window.eskfReport = {goTo, goToPlace};
  start();
})();
"""

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<link rel="icon" href="data:,">
<style>{style}</style>
{bokeh}
</head>
<body>
<header>{heading}</header>
<div class="summary">
{verdict}
<div class="two">
<div>{findings}<div class="tiles">{tiles}</div></div>
<div><h2>What became of the measurements</h2>
{aids}
{notes}</div>
</div>
</div>
<nav>{navigation}</nav>
<main>
<div class="mapcard">{map}</div>
<div>{sections}</div>
</main>
<footer>Curves keep the first, the largest and the smallest value of each of 600 intervals: no peak is lost. Times are
seconds since the first position. Click a name in a legend to hide its curve; drag over a plot to zoom all of them, and
reset with the round arrow. Colours after Okabe and Ito, for every kind of colour vision.</footer>
{figures}
<script>{script}</script>
</body>
</html>
"""
