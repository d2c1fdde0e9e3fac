"""Script of the page of `play`: asks for the next picture as soon as the last one is shown, sends only the latest wish."""
# ruff: noqa: E501 - lines of JavaScript

SCRIPT = r"""
'use strict';
const facts = JSON.parse(document.getElementById('facts').textContent);
const at = id => document.getElementById(id), all = selector => [...document.querySelectorAll(selector)];
const canvas = at('picture'), paper = canvas.getContext('2d'), sliders = all('.slider');
const byName = new Map(sliders.map(s => [s.dataset.name, s]));
let state = facts.state, wish = null, sending = false, sent = new Map(), lag = null, alive = true;
document.documentElement.style.setProperty('--aspect', facts.aspect);

// ---- what the user wants: one message under way, the later wishes are put together
const ask = (path, options) => fetch(path, options).then(async answer => {
  if (answer.ok) return answer;
  const told = await answer.json().catch(() => ({error: answer.statusText}));
  throw new Error(told.error);
});
function complain(sentence) { at('error').textContent = sentence || ''; at('error').hidden = !sentence; }
function want(change) {
  wish = {...wish, ...change, sliders: {...(change.reset ? {} : wish && wish.sliders), ...change.sliders}};
  if (!Object.keys(wish.sliders).length) delete wish.sliders;
  send();
}
async function send() {
  if (sending || !wish) return;
  sending = true;
  const body = JSON.stringify(wish), begun = performance.now(), source = wish.source;
  wish = null;
  try {
    const {version} = await (await ask('state', {method: 'POST', body})).json();
    sent.set(version, begun);
    if (sent.size > 50) sent.delete(sent.keys().next().value);
    if (source) complain('');
  } catch (error) { complain(error.message); if (source) refresh(); }
  sending = false;
  send();
}

// ---- sliders
const degrees = s => !('seen' in s.dataset);
function show(slider) {
  const value = +slider.value, row = slider.closest('.row');
  row.querySelector('output').textContent = degrees(slider) ? value.toFixed(0) + '\u00b0' : value.toFixed(2);
  row.classList.toggle('moved', Math.abs(value - slider.dataset.rest) > 1e-3 * (slider.max - slider.min));
}
function set(slider, value) { slider.value = value; show(slider); return [slider.dataset.name, Math.min(slider.max, Math.max(slider.min, +value))]; }
for (const slider of sliders) {
  if (slider.dataset.seen) {
    const part = v => 100 * (v - slider.min) / (slider.max - slider.min) + '%', [low, high] = slider.dataset.seen.split(' ');
    slider.style.setProperty('--from', part(low)); slider.style.setProperty('--to', part(high));
  }
  slider.addEventListener('input', () => {
    const moved = [set(slider, slider.value)], twin = at('both').checked && byName.get(slider.dataset.twin);
    if (twin) moved.push(set(twin, slider.value));
    want({sliders: Object.fromEntries(moved)});
  });
  slider.addEventListener('dblclick', () => want({sliders: Object.fromEntries([set(slider, slider.dataset.rest)])}));
}
const strength = at('strength');
strength.addEventListener('input', () => { strength.nextElementSibling.textContent = (+strength.value).toFixed(2); want({strength: +strength.value}); });
at('reset').addEventListener('click', () => { sliders.forEach(s => set(s, s.dataset.rest)); strength.value = 1; strength.nextElementSibling.textContent = '1.00'; want({reset: true}); });
for (const undo of all('.undo')) undo.addEventListener('click', event => {
  event.preventDefault();
  want({sliders: Object.fromEntries(all(`.row[data-group="${undo.dataset.group}"] .slider`).map(s => set(s, s.dataset.rest)))});
});

// ---- turning the head by dragging over the picture
let grip = null;
canvas.addEventListener('pointerdown', event => { grip = [event.clientX, event.clientY, +byName.get('turn_right').value, +byName.get('turn_up').value]; canvas.setPointerCapture(event.pointerId); });
canvas.addEventListener('pointermove', event => {
  if (!grip) return;
  const scale = 150 / canvas.clientWidth, side = at('mirror').checked ? -1 : 1;
  const moved = [set(byName.get('turn_right'), grip[2] + side * scale * (event.clientX - grip[0])), set(byName.get('turn_up'), grip[3] - scale * (event.clientY - grip[1]))];
  want({sliders: Object.fromEntries(moved)});
});
for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, () => { grip = null; });
canvas.addEventListener('dblclick', () => want({sliders: Object.fromEntries(['turn_right', 'turn_up', 'tilt_right'].map(n => set(byName.get(n), 0)))}));

// ---- source and transport
function arrange() {
  for (const input of all('[name=source]')) {
    input.checked = input.value === state.source;
    input.disabled = !(state.sources.includes(input.value) || input.value === 'file');
    if (input.value === 'video') input.closest('label').hidden = !facts.video;
  }
  for (const part of all('[data-for]')) part.hidden = !part.dataset.for.split(' ').includes(state.source);
  const frames = state.frames[state.source];
  at('place').hidden = !frames; at('place').max = (frames || 1) - 1;
  at('play').hidden = state.source === 'sliders';
  at('play').textContent = state.playing ? 'Pause' : 'Play'; at('play').setAttribute('aria-pressed', state.playing);
  at('driver').hidden = !['video', 'camera'].includes(state.source);
  at('smooth').checked = state.smooth; at('size').value = state.size;
  if (!frames) at('where').textContent = '';
}
async function refresh() { state = await (await ask('state')).json(); arrange(); }
function choose(change) { Object.assign(state, change); arrange(); want(change); }
for (const input of all('[name=source]')) input.addEventListener('change', () => {
  if (input.value !== 'camera') stopCamera();
  if (input.value === 'file' && !state.sources.includes('file')) {  // nothing to play yet: only its part of the page is shown
    for (const part of all('[data-for]')) part.hidden = !part.dataset.for.split(' ').includes('file');
    return;
  }
  if (input.value === 'camera') startCamera(); else { mirror(false); choose({source: input.value, playing: true}); }
});
at('play').addEventListener('click', () => choose({playing: !state.playing}));
at('place').addEventListener('input', () => choose({place: +at('place').value, playing: false}));
at('size').addEventListener('change', () => choose({size: +at('size').value}));
at('smooth').addEventListener('change', () => choose({smooth: at('smooth').checked}));
at('neutral').addEventListener('click', () => want({neutral: true}));
at('calibrate').addEventListener('click', () => want({calibrate: true}));
function mirror(on) { at('mirror').checked = on; canvas.classList.toggle('mirrored', on); at('driver').classList.toggle('mirrored', on); }
at('mirror').addEventListener('change', () => mirror(at('mirror').checked));
document.addEventListener('keydown', event => {
  if (event.key !== ' ' || !['BODY', 'CANVAS'].includes(document.activeElement.tagName) || state.source === 'sliders') return;
  event.preventDefault(); choose({playing: !state.playing});
});
at('file').addEventListener('change', async () => {
  const file = at('file').files[0];
  if (!file) return;
  try {
    await ask('file?name=' + encodeURIComponent(file.name), {method: 'POST', body: file});
    at('filename').textContent = `Playing ${file.name}.`; complain(''); await refresh();
  } catch (error) { complain(error.message); }
  at('file').value = '';
});

// ---- webcam, or a video that the browser plays: one picture under way, always the latest
let camera = null;
const eye = document.createElement('video'), small = document.createElement('canvas');
eye.muted = true; eye.playsInline = true; eye.loop = true;
function stopCamera() {
  if (!camera) return;
  const {stream, url} = camera;
  camera = null;
  if (stream) stream.getTracks().forEach(track => track.stop());
  eye.pause(); eye.srcObject = null; eye.removeAttribute('src');
  if (url) URL.revokeObjectURL(url);
}
async function startCamera(file) {
  stopCamera();
  try {
    if (file) { camera = {url: URL.createObjectURL(file)}; eye.src = camera.url; }
    else {
      if (!navigator.mediaDevices) throw new Error('this browser gives no camera to the page');
      const stream = await navigator.mediaDevices.getUserMedia({video: {width: {ideal: 640}, height: {ideal: 480}, frameRate: {ideal: 30}}, audio: false});
      camera = {stream}; eye.srcObject = stream;
    }
    await eye.play();
  } catch (error) { stopCamera(); complain('The camera or video cannot be used: ' + error.message); await refresh(); return; }
  mirror(!file);
  const mine = camera;
  choose({source: 'camera', playing: true, ...(file ? {calibrate: true} : {})});
  while (camera === mine && alive) await film();
}
at('film').addEventListener('change', () => { const file = at('film').files[0]; if (file) startCamera(file); at('film').value = ''; });
const rest = milliseconds => new Promise(done => setTimeout(done, milliseconds));
let lastTime = -1;
async function film() {
  if (!state.playing || eye.readyState < 2 || eye.currentTime === lastTime) return rest(4);
  lastTime = eye.currentTime;
  const scale = Math.min(1, 640 / Math.max(eye.videoWidth, eye.videoHeight));
  small.width = Math.round(eye.videoWidth * scale); small.height = Math.round(eye.videoHeight * scale);
  small.getContext('2d').drawImage(eye, 0, 0, small.width, small.height);
  const blob = await new Promise(done => small.toBlob(done, 'image/jpeg', .85));
  try {
    const {taken} = await (await ask('camera', {method: 'POST', body: blob})).json();
    if (!taken) await rest(50);
  } catch (error) { complain(error.message); await rest(500); }
}
async function preview() {
  while (alive) {
    await rest(200);
    if (at('driver').hidden || document.hidden) continue;
    try {
      const answer = await ask('driver');
      if (answer.status === 200) { const old = at('preview').src; at('preview').src = URL.createObjectURL(await answer.blob()); if (old) URL.revokeObjectURL(old); }
    } catch { /* the next one */ }
  }
}

// ---- pictures
const NAMES = {detect: 'detect face', solve: 'solve', pose: 'pose', networks: 'networks', raster: 'rasterise', draw: facts.live ? 'composite' : 'march', jpeg: 'JPEG', lag: 'slider to screen'};
let told = 0;
function tell(data) {
  if (data.fault) { at('over').textContent = data.fault; at('over').hidden = false; return; }
  at('over').hidden = true;
  const place = data.place >= 0 && state.source === data.source ? data.place : null;
  if (place !== null) {
    if (document.activeElement !== at('place') || state.playing) at('place').value = place;
    const frame = data.source === 'clip' ? facts.clip_frames[place] : place, part = data.source === 'clip' && facts.clip_parts[place];
    at('where').textContent = `frame ${frame}` + (part ? `, ${part === 'train' ? 'training' : part}` : '');
  }
  at('note').textContent = data.note || '';
  const now = performance.now();
  if (now - told < 250) return;  // figures that flicker cannot be read
  told = now;
  at('fps').textContent = data.fps ? data.fps.toFixed(data.fps < 10 ? 1 : 0) : '\u2013';
  at('draw').textContent = data.ms.frame.toFixed(data.ms.frame < 10 ? 1 : 0);
  if (at('able')) at('able').textContent = (1000 / (data.ms.frame + data.ms.jpeg)).toFixed(1);
  const times = {...data.ms, ...(lag === null ? {} : {lag})};
  at('times').replaceChildren(...Object.entries(NAMES).filter(([key]) => key in times).map(([key, name]) => {
    const line = document.createElement('div'), word = document.createElement('dt'), figure = document.createElement('dd');
    word.textContent = name; figure.textContent = times[key].toFixed(times[key] < 10 ? 1 : 0) + ' ms'; line.append(word, figure);
    return line;
  }));
}
async function watch() {
  let number = 0;
  while (alive) {
    try {
      const answer = await ask(`picture?after=${number}`);
      if (answer.status === 204) continue;
      const data = JSON.parse(answer.headers.get('X-Play')), blob = await answer.blob();
      number = data.number;
      if (blob.size) {
        const bitmap = await createImageBitmap(blob);
        if (canvas.width !== bitmap.width || canvas.height !== bitmap.height) { canvas.width = bitmap.width; canvas.height = bitmap.height; }
        paper.drawImage(bitmap, 0, 0); bitmap.close();
      }
      canvas.dataset.number = number; canvas.dataset.version = data.version;
      if (sent.has(data.version)) { lag = performance.now() - sent.get(data.version); for (const key of sent.keys()) if (key <= data.version) sent.delete(key); }
      tell(data);
      if (document.hidden) await rest(500);
    } catch (error) {
      at('over').textContent = 'The program on this computer has ended, or does not answer.'; at('over').hidden = false;
      await rest(1000);
    }
  }
}
for (const [name, value] of Object.entries(state.sliders)) if (byName.has(name)) set(byName.get(name), value);
strength.value = state.strength; strength.nextElementSibling.textContent = state.strength.toFixed(2);
if (state.source === 'camera') { state.source = 'sliders'; want({source: 'sliders'}); }  // the page that filmed is gone
arrange(); watch(); preview();
"""
