"""The player's script: one video, drawn tile by tile; plain JavaScript that works from disk, without modules or requests."""

SCRIPT = r"""
(() => {
'use strict';
document.documentElement.classList.add('js');
const root = document.querySelector('.player');
const data = JSON.parse(document.getElementById('player-data').textContent);
const one = name => root.querySelector(name), all = name => [...root.querySelectorAll(name)];
const video = one('video'), scrub = one('.scrub'), play = one('.play'), where = one('.where');
const differ = one('.differ'), metric = one('.metric'), curve = one('.curve');
const figures = all('.panels figure'), count = data.frames.length;
const icons = {play: 'M3 1v14l11-7z', pause: 'M3 1h4v14H3zM10 1h4v14h-4z'};
let place = 0, wanted = null, going = null;   // shown; asked for; on its way
video.controls = false; video.removeAttribute('aria-label'); video.setAttribute('aria-hidden', 'true'); video.tabIndex = -1;

const clamp = index => Math.max(0, Math.min(count - 1, index));
const number = (value, item) => value.toFixed(item.digits) + (item.unit ? ' ' + item.unit : '');

// ---- pictures: each visible tile of the video's present frame on its canvas
function paint() {
  if (video.readyState < 2) return;
  figures.forEach((figure, index) => {
    if (figure.hidden) return;
    const canvas = figure.querySelector('canvas'), pen = canvas.getContext('2d');
    const tile = panel => pen.drawImage(video, panel.left, panel.top, data.width, data.height, 0, 0, data.width, data.height);
    const differs = differ.checked && index > 0 && !data.panels[index].lost.includes(place);
    canvas.classList.toggle('difference', differs);
    pen.globalCompositeOperation = 'source-over';
    tile(data.panels[index]);
    if (differs) { pen.globalCompositeOperation = 'difference'; tile(data.panels[0]); }
  });
}

// ---- words: frame, time and the frame's own figures
function tell() {
  const frame = data.frames[place], time = data.time_s[place].toFixed(2) + ' s';
  scrub.value = place;
  scrub.setAttribute('aria-valuetext', `frame ${frame}, ${time}`);
  where.textContent = `frame ${frame} · ${time} · ${place + 1} of ${count}`;
  const chosen = data.metrics.filter(item => item.key === 'lpips' || item.key === 'psnr');
  const shown = data.panels.slice(1).filter((panel, index) => !figures[index + 1].hidden && data.scores[panel.name]);
  const best = chosen.map(item => {
    const values = shown.map(panel => data.scores[panel.name][item.key][place]).filter(value => value !== null);
    return values.length < 2 ? null : item.better[0] === 'l' ? Math.min(...values) : Math.max(...values);
  });
  data.panels.forEach((panel, index) => {
    const line = figures[index].querySelector('.here');
    line.textContent = '';
    if (!index) return;
    if (panel.lost.includes(place)) { line.textContent = 'not rendered'; return; }
    const scores = data.scores[panel.name];
    const known = chosen.filter(item => scores && scores[item.key][place] !== null);
    if (!known.length) line.textContent = 'not scored';
    known.forEach((item, order) => {
      const part = document.createElement('span'), value = scores[item.key][place];
      part.textContent = `${item.title} ${number(value, item)}`;
      if (value === best[chosen.indexOf(item)]) part.className = 'best';
      line.append(order ? ' · ' : '', part);
    });
  });
  const now = curve.querySelector('.now');
  if (now) { now.setAttribute('x1', across(place)); now.setAttribute('x2', across(place)); }
}

function show(index) { place = clamp(index); paint(); tell(); root.dataset.place = place; }

// ---- time: the middle of a frame is safely inside it
function seek(index) {
  wanted = clamp(index);
  if (!video.paused) video.pause();
  place = wanted;
  tell();
  if (going === null) go();
}
function go() { going = wanted; video.currentTime = (going + 0.5) / data.fps; }
video.addEventListener('seeked', () => {
  if (going === null) return;
  if (wanted !== going) { paint(); go(); return; }
  going = null;
  show(wanted);
});
// Fires for each frame that is ready to be drawn; mediaTime is where that very frame begins.
if (video.requestVideoFrameCallback) {
  const fresh = (now, about) => {
    if (!video.paused) show(Math.round(about.mediaTime * data.fps));
    else if (going === null) paint();   // a seek has ended before its picture was there
    video.requestVideoFrameCallback(fresh);
  };
  video.requestVideoFrameCallback(fresh);
} else {
  const beat = () => {
    if (!video.paused) show(Math.floor(video.currentTime * data.fps + 1e-3));
    requestAnimationFrame(beat);
  };
  beat();
}
function toggle() {
  if (!video.paused) { seek(place); return; }
  going = wanted = null;
  if (place === count - 1) video.currentTime = 0;
  video.play().catch(() => {});
}
function button() {
  const running = !video.paused;
  play.querySelector('path').setAttribute('d', running ? icons.pause : icons.play);
  play.setAttribute('aria-label', running ? 'Pause' : 'Play');
}
['play', 'pause', 'ended'].forEach(name => video.addEventListener(name, button));
video.addEventListener('error', () => { where.textContent = 'This browser cannot play the video (H.264).'; });
const begin = () => seek(0);
if (video.readyState >= 1) begin(); else video.addEventListener('loadedmetadata', begin, {once: true});

// ---- controls
play.addEventListener('click', toggle);
one('.back').addEventListener('click', () => seek(place - 1));
one('.on').addEventListener('click', () => seek(place + 1));
scrub.addEventListener('input', () => seek(+scrub.value));
one('.speed').addEventListener('change', event => { video.playbackRate = +event.target.value; });
one('.loop').addEventListener('click', event => {
  video.loop = !video.loop;
  event.currentTarget.setAttribute('aria-pressed', video.loop);
});
differ.addEventListener('change', paint);
one('.size').addEventListener('change', event => one('.panels').classList.toggle('natural', event.target.checked));
function arrange() {   // rows of at most four, as even as can be
  const shown = figures.filter(figure => !figure.hidden).length;
  one('.panels').style.setProperty('--columns', Math.ceil(shown / Math.ceil(shown / 4)));
}
all('.show').forEach(box => box.addEventListener('change', () => {
  figures[+box.value].hidden = !box.checked;
  arrange(); draw(); show(place);
}));
root.addEventListener('keydown', event => {
  if (event.altKey || event.ctrlKey || event.metaKey || event.target.tagName === 'SELECT') return;
  const own = /BUTTON/.test(event.target.tagName) || event.target.type === 'checkbox';
  const step = event.shiftKey ? 10 : 1;
  if (event.key === ' ' && !own) toggle();
  else if (event.key === 'ArrowLeft') seek(place - step);
  else if (event.key === 'ArrowRight') seek(place + step);
  else if (event.key === 'Home') seek(0);
  else if (event.key === 'End') seek(count - 1);
  else return;
  event.preventDefault();
});
document.querySelectorAll('.jump').forEach(item => item.addEventListener('click', () => {
  const box = all('.show').find(each => data.panels[+each.value].name === item.dataset.variant);
  if (box && !box.checked) box.click();
  seek(data.frames.indexOf(+item.dataset.frame));
  root.scrollIntoView({block: 'start'});
  root.focus({preventScroll: true});
}));

// ---- curve
const margin = 8, height = 150;
const across = index => margin + (curve.clientWidth - 2 * margin) * (count > 1 ? index / (count - 1) : 0.5);
function node(name, attributes, text) {
  const made = document.createElementNS('http://www.w3.org/2000/svg', name);
  for (const key in attributes) made.setAttribute(key, attributes[key]);
  if (text !== undefined) made.textContent = text;
  curve.append(made);
  return made;
}
function draw() {
  curve.replaceChildren();
  const item = data.metrics.find(each => each.key === metric.value), width = curve.clientWidth;
  if (!item || !width) return;
  curve.setAttribute('viewBox', `0 0 ${width} ${height}`);
  const lines = data.panels.map((panel, index) => ({panel, values: (data.scores[panel.name] || {})[item.key], index}))
    .filter(line => line.values && !figures[line.index].hidden);
  const known = lines.flatMap(line => line.values.filter(value => value !== null));
  if (!known.length) { node('text', {x: 12, y: 24}, 'no scored frame'); return; }
  const low = Math.min(...known), high = Math.max(...known), range = high - low || 1;
  const up = value => height - 14 - (height - 34) * (value - low) / range;
  const levels = high > low ? [low, (low + high) / 2, high] : [low];
  levels.forEach(level => node('line', {class: 'grid', x1: 0, x2: width, y1: up(level), y2: up(level)}));
  lines.forEach(({panel, values}) => {
    let path = '', pen = 'M';
    values.forEach((value, index) => {
      if (value === null) { pen = 'M'; return; }
      path += `${pen}${across(index).toFixed(1)} ${up(value).toFixed(1)}`;
      pen = 'L';
    });
    node('path', {class: 'line', d: path, style: `stroke:var(${panel.colour})`, 'stroke-dasharray': panel.dash});
    if (count < 60) values.forEach((value, index) => {
      if (value !== null) node('circle', {cx: across(index), cy: up(value), r: 3, style: `fill:var(${panel.colour})`});
    });
  });
  levels.forEach(level => node('text', {x: 4, y: up(level) - 4}, number(level, item)));
  node('line', {class: 'now', x1: across(place), x2: across(place), y1: 0, y2: height});
}
function point(event) {
  const box = curve.getBoundingClientRect();
  seek(Math.round((event.clientX - box.left - margin) / (box.width - 2 * margin) * (count - 1)));
}
curve.addEventListener('pointerdown', event => { curve.setPointerCapture(event.pointerId); point(event); });
curve.addEventListener('pointermove', event => { if (curve.hasPointerCapture(event.pointerId)) point(event); });
metric.addEventListener('change', draw);
new ResizeObserver(draw).observe(curve);
arrange(); tell();
})();
"""
