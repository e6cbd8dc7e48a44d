// The page: a socket, what it brings, and what it asks for.

import { MapView, TINT } from './map.js';
import { Plot, roundUp } from './plot.js';
import { statusOf } from './status.js';

const DRIVE_PERIOD_MS = 100;
const RETRY_MS = 1000;
const LATE_MS = 500; // a page that has heard nothing for so long does not drive
const GONE_MS = 1500; // and says so
const HINTS = {
  pan: '',
  goal: 'Click where the robot should go; drag for its heading.',
  initial_pose: 'Click where the robot is; drag for its heading.',
  limit: 'Click the corners of the area to explore; Explore starts, Limit again clears.',
  keep_out: 'Click the corners of an area that robots must not enter, then Done.',
  wall: 'Click the points of a line that robots must not cross, then Done.',
  erase: 'Click the corners of a part of the map that becomes unknown, then Done.',
};
const CELLS = { free: 'var(--free)', wall: 'var(--wall)', unknown: 'var(--unknown)' };
const MOST_EVENTS = 50;
const CLICK_PX = 5; // a pointer that moves no farther has clicked
const LEAST_CORNERS = { keep_out: 3, wall: 2, erase: 3 };
const items = new Map();
const find = (id) => document.getElementById(id);
const view = new MapView(find('map'), items);
const plots = {
  coverage: new Plot(find('plot-coverage'), 'coverage over path', '%', 'm'),
  step: new Plot(find('plot-step'), 'step of the localizer', 'ms', 's'),
  inliers: new Plot(find('plot-inliers'), 'scan points on walls', '%', 's'),
};
let socket = null;
let mode = 'pan';
let limit = [];
let drawn = []; // corners of what is being drawn: an area, a wall, a part to erase
const state = { opened: performance.now(), heard: 0, link: '', slam: '' };
const own = []; // events of this page: time, s, and words
window.thinmap = { items, view }; // for tests and the curious

function ask(action, values = {}) {
  // The newest beat says how old a request is when it arrives.
  const beat = items.get('beat');
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ action, beat, ...values }));
  else say('not connected: nothing was sent');
}

function say(text) {
  own.push([Date.now() / 1000, text]);
  showEvents();
}

// The newest first, those of the robot and of this page.
function showEvents() {
  const events = [...(items.get('news') ?? []), ...own].sort((a, b) => b[0] - a[0]);
  find('log').replaceChildren(...events.slice(0, MOST_EVENTS).map(([seconds, text]) => {
    const line = document.createElement('li');
    const time = document.createElement('time');
    time.append(new Date(1000 * seconds).toTimeString().slice(0, 8));
    line.append(time, text);
    return line;
  }));
}

const silentMs = () => performance.now() - state.heard;

// What is heard from the robot: words, and whether what is shown is what is.
function link() {
  const seconds = Math.round(silentMs() / 1000);
  if (!state.link) return { text: 'connecting', isLive: false };
  if (state.link === 'connected' || state.link === 'watching') {
    const isLive = silentMs() < GONE_MS;
    return { text: isLive ? state.link : `late: nothing heard for ${seconds} s`, isLive };
  }
  const since = state.heard ? `, nothing heard for ${seconds} s` : '';
  return { text: `${state.link}${since}`, isLive: false };
}

function showStatus() {
  const now = link();
  const [level, text] = statusOf(items, now);
  find('status').textContent = text;
  find('status').className = level;
  find('status').title = text;
  document.body.classList.toggle('old', !now.isLive);
  showButtons(now.isLive);
}

// Why a button would do nothing, as the page itself knows.
const missing = {
  go_to_region: () => (find('regions').value ? '' : 'no region is known yet'),
  name_region: () => (find('regions').value ? '' : 'no region is known yet'),
  save: () => (find('name').value ? '' : 'expected a name of the map'),
  load: () => (sessions().includes(find('name').value) ? '' : 'expected the name of a saved map'),
  merge: () => (sessions().length > 1 ? '' : 'expected two saved maps'),
};
const sessions = () => items.get('sessions') ?? [];

function showButtons(isLive) {
  const refusals = items.get('refusals') ?? {};
  for (const button of document.querySelectorAll('[data-does]')) {
    const does = button.dataset.does;
    const reason = isLive ? refusals[does] || missing[does]?.() || '' : 'no link to the robot';
    if (does !== 'merge' || !isMerging()) button.disabled = Boolean(reason);
    button.title = reason;
  }
  find('resume').hidden = Boolean(refusals.resume);
  find('pause').hidden = !find('resume').hidden;
}

setInterval(showStatus, LATE_MS);

// Ask before something is lost. It is no modal dialog: STOP has to work meanwhile.
function whenSure(question, verb, act) {
  find('sure').hidden = false;
  find('sure').firstElementChild.textContent = question;
  find('sure-yes').textContent = verb;
  find('sure-no').onclick = () => {
    find('sure').hidden = true;
  };
  find('sure-yes').onclick = () => {
    find('sure').hidden = true;
    act();
  };
  find('sure-no').focus();
}

function connect() {
  const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
  socket = new WebSocket(`${scheme}://${location.host}/socket`);
  socket.onopen = () => socket.send(JSON.stringify({ token: location.hash.slice(1) }));
  socket.onmessage = (event) => JSON.parse(event.data).forEach(([name, value]) => take(name, value));
  socket.onclose = (event) => {
    release();
    const isRefused = event.code === 1008;
    const before = state.link;
    state.link = isRefused ? event.reason || 'refused' : `${event.reason || 'lost'}: trying again`;
    if (state.heard && state.link !== before) say(`link ${state.link}`);
    showStatus();
    if (!isRefused) setTimeout(connect, RETRY_MS);
  };
}

const takers = {
  hello: ({ role }) => {
    // All of what is shown comes again, and what is no longer there does not.
    items.clear();
    view.newMap();
    document.body.classList.toggle('watch', role !== 'steer');
    state.heard = performance.now();
    state.link = role === 'steer' ? 'connected' : 'watching';
    if (role === 'steer') ask('sessions');
  },
  beat: () => {
    state.heard = performance.now();
  },
  map: () => view.newMap(),
  graph: ({ edges }) => {
    // Of edges that are gone, no word comes.
    const known = new Set(edges.map((id) => `edge/${id}`));
    for (const name of items.keys()) if (name.startsWith('edge/') && !known.has(name)) items.delete(name);
  },
  slam: (slam) => {
    find('slam-state').textContent = slam.state;
    find('slam-state').className = slam.is_well ? '' : 'bad';
    find('slam-detail').textContent = slam.detail;
    if (state.slam && slam.state !== state.slam) say(slam.state);
    state.slam = slam.state;
    const seconds = (performance.now() - state.opened) / 1000;
    plots.step.add(seconds, slam.step_ms);
    plots.inliers.add(seconds, 100 * slam.inliers);
  },
  exploration: (status) => {
    find('exploration-state').textContent = status.state;
    find('exploration-detail').textContent = status.detail;
    plots.coverage.add(status.distance, 100 * status.coverage);
  },
  news: showEvents,
  refused: say,
  held: (stop) => {
    const isHeld = stop > 0;
    find('stop').textContent = isHeld ? 'STOPPED' : 'STOP';
    find('stop').classList.toggle('held', isHeld);
    find('release').hidden = !isHeld;
  },
  regions: (regions) => {
    const chosen = find('regions').value;
    find('regions').replaceChildren(...regions.map((region) => new Option(region.name, region.id)));
    if (regions.some((region) => `${region.id}` === chosen)) find('regions').value = chosen;
    if (!regions.some((region) => region.id === view.chosen)) view.chosen = null;
  },
  sessions: (names) => {
    find('sessions').replaceChildren(...names.map((name) => new Option(name)));
    for (const id of ['first', 'second']) {
      const chosen = find(id).value;
      find(id).replaceChildren(...names.map((name) => new Option(name)));
      if (names.includes(chosen)) find(id).value = chosen;
    }
  },
  merge: showMerge,
  keep_out: (areas) => {
    find('keep-out').replaceChildren(...areas.map(({ id, name }) => {
      const line = document.createElement('li');
      const remove = document.createElement('button');
      remove.append('Remove');
      remove.className = 'steer';
      remove.onclick = () => ask('remove_keep_out', { area: id });
      line.append(`${name} `, remove);
      return line;
    }));
  },
  diagnostics: (rows) => {
    find('diagnostics').replaceChildren(...rows.map(([level, name, message]) => {
      const row = document.createElement('tr');
      [level, name.replace(/: thinmap$/, ''), message].forEach((text) => row.insertCell().append(text));
      row.cells[0].className = level;
      return row;
    }));
  },
  key: showKey,
};

// A line for each layer: a switch, and the colours that are drawn in it.
function showKey(key) {
  view.colours = Object.fromEntries(Object.values(key).flatMap(Object.entries).map(([name, [first]]) => [name, first]));
  const cells = Object.entries(CELLS).map(([name, colour]) => entry(name, [colour]));
  const map = document.createElement('li');
  map.append(...cells);
  find('key').replaceChildren(map, ...Object.entries(key).map(([layer, names]) => {
    const line = document.createElement('li');
    const shown = document.createElement('input');
    shown.type = 'checkbox';
    shown.checked = !view.hidden.has(layer);
    shown.ariaLabel = layer;
    shown.onchange = () => {
      if (shown.checked) view.hidden.delete(layer);
      else view.hidden.add(layer);
      view.redraw();
    };
    const words = document.createElement('div');
    words.append(...Object.entries(names).map(([name, colours]) => entry(name, colours.map(layer === 'regions' ? tinted : String))));
    line.append(shown, words);
    return line;
  }));
}

// Colour of a region where it is drawn: on free cells.
const tinted = (colour) => `color-mix(in srgb, ${colour} ${100 * TINT}%, var(--free))`;

function entry(name, colours) {
  const words = document.createElement('span');
  for (const colour of colours) {
    const patch = document.createElement('i');
    patch.style.background = colour;
    words.append(patch);
  }
  words.append(name);
  return words;
}

const isMerging = () => ['working', 'shown'].includes(items.get('merge')?.state);

async function showMerge({ state: stage, words, picture }) {
  find('merge-words').textContent = [stage, ...words].filter(Boolean).join('\n');
  find('merge').disabled = isMerging();
  find('merged').hidden = stage !== 'shown';
  find('merge-drop').hidden = !isMerging();
  const canvas = find('merge-picture');
  canvas.hidden = !picture;
  if (!picture) return;
  const bytes = Uint8Array.from(atob(picture), (c) => c.charCodeAt(0));
  const image = await createImageBitmap(new Blob([bytes], { type: 'image/png' }));
  [canvas.width, canvas.height] = [image.width, image.height];
  canvas.getContext('2d').drawImage(image, 0, 0);
}

function take(name, value) {
  if (name.startsWith('tile/')) {
    view.setTile(name, value);
    return;
  }
  if (name !== 'hello') items.set(name, value);
  takers[name]?.(value);
  if (name === 'beat') return;
  view.redraw();
  if (TELLING.has(name)) showStatus();
}
const TELLING = new Set(['hello', 'held', 'held_by', 'slam', 'goal', 'exploration', 'diagnostics', 'refusals', 'regions', 'sessions', 'scan_age']);

// Stop: also while something else has the focus, except the name of a region.

function stop() {
  release();
  ask('stop');
}
find('stop').onclick = stop;
find('release').onclick = () => ask('release', { stop: items.get('held') });
addEventListener('keydown', (event) => {
  if (event.code !== 'Space' || event.target.id === 'region-name') return;
  event.preventDefault();
  if (!event.repeat) stop();
}, true);
addEventListener('keydown', (event) => {
  if (event.code !== 'Escape') return;
  find('sure').hidden = true;
  view.sketch = null;
  limit = [];
  drawn = [];
  setMode('pan');
});
addEventListener('keyup', (event) => {
  if (event.code === 'Space' && event.target.id !== 'region-name') event.preventDefault();
}, true);

// Buttons.

for (const action of ['pause', 'resume', 'cancel', 'home']) find(action).onclick = () => ask(action);
find('explore').onclick = () => {
  if (limit.length === 1 || limit.length === 2) {
    say('the limit of an exploration has 3 corners or more');
    return;
  }
  ask('explore', { area: limit, return_home: find('return-home').checked });
};
find('go').onclick = () => {
  if (find('regions').value) ask('go_to_region', { region: Number(find('regions').value) });
};
// In this field alone the space bar types; it has the focus no longer than it is needed.
find('region-name').onchange = (event) => event.target.blur();
find('name-region').onclick = () => {
  const region = Number(find('regions').value);
  if (region) ask('name_region', { region, name: find('region-name').value });
};
find('regions').onchange = (event) => chooseRegion(event.target.value);
find('name').oninput = showStatus;
find('save').onclick = () => {
  const name = find('name').value;
  const save = () => ask('save', { name });
  if (sessions().includes(name)) whenSure(`${name} exists. Replace it?`, 'Replace', save);
  else save();
};
find('load').onclick = () => {
  const name = find('name').value;
  const question = `Load ${name}? The map in use is lost where it is not saved.`;
  whenSure(question, 'Load', () => ask('load', { name }));
};
find('merging').ontoggle = (event) => {
  if (event.target.open) ask('sessions');
};
find('merge').onclick = () => ask('merge', { first: find('first').value, second: find('second').value });
find('merge-save').onclick = () => ask('merge_save', { name: find('merged-name').value });
find('merge-drop').onclick = () => ask('merge_drop');
find('zoom-in').onclick = () => view.zoom(1.4);
find('zoom-out').onclick = () => view.zoom(1 / 1.4);
find('fit').onclick = () => view.fit();
find('follow').onchange = (event) => {
  view.follow = event.target.checked;
  view.showsAll = false;
  view.redraw();
};
function chooseRegion(id) {
  find('regions').value = id;
  view.chosen = Number(id);
  view.redraw();
}
function setTheme(isDark) {
  document.documentElement.classList.toggle('dark', isDark);
  view.newTheme();
  Object.values(plots).forEach((plot) => plot.draw());
}
setTheme(matchMedia('(prefers-color-scheme: dark)').matches);
find('theme').onclick = () => setTheme(!document.documentElement.classList.contains('dark'));

for (const button of document.querySelectorAll('[data-mode]')) {
  button.onclick = () => {
    if (button.dataset.mode === 'limit') {
      limit = [];
      view.sketch = null;
    }
    forgetDrawn();
    setMode(button.dataset.mode);
  };
}

function forgetDrawn() {
  if (drawn.length) view.sketch = null;
  drawn = [];
}

find('done').onclick = () => {
  if (drawn.length < LEAST_CORNERS[mode]) {
    say(`expected ${LEAST_CORNERS[mode]} corners or more`);
    return;
  }
  if (mode === 'erase') ask('erase', { corners: drawn });
  else ask('keep_out', { corners: drawn, is_wall: mode === 'wall' });
  forgetDrawn();
  setMode('pan');
};

function setMode(chosen) {
  mode = chosen;
  find('done').hidden = !(mode in LEAST_CORNERS);
  find('hint').textContent = HINTS[mode];
  for (const button of document.querySelectorAll('[data-mode]')) {
    button.classList.toggle('chosen', button.dataset.mode === mode);
  }
  view.redraw();
}

// The map under one pointer or two.

const pointers = new Map();
let hasPinched = false; // since there was no pointer
let pressed = [0, 0];
const canvas = find('map');
const placeOf = (event) => [event.offsetX, event.offsetY];

canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, placeOf(event));
  hasPinched = pointers.size > 1;
  pressed = placeOf(event);
  if (hasPinched) view.sketch = null;
  else if (mode === 'goal' || mode === 'initial_pose') {
    view.sketch = { from: view.toMap(...placeOf(event)), to: null };
  }
};
canvas.onpointermove = (event) => {
  showPlace(...view.toMap(...placeOf(event)));
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = placeOf(event);
  if (pointers.size === 2) pinch(event.pointerId, before, now);
  else if (view.sketch?.from) turn(now);
  else if (mode === 'pan') {
    view.centre[0] -= (now[0] - before[0]) / view.scale;
    view.centre[1] += (now[1] - before[1]) / view.scale;
    find('follow').checked = view.follow = view.showsAll = false;
  }
  pointers.set(event.pointerId, now);
  view.redraw();
};
canvas.onpointerup = (event) => {
  const isSingle = pointers.size === 1 && !hasPinched;
  pointers.delete(event.pointerId);
  const place = view.toMap(...placeOf(event));
  if (isSingle && view.sketch?.from) finish();
  else if (isSingle && mode === 'limit') {
    limit.push(place);
    view.sketch = { corners: limit };
  } else if (isSingle && mode in LEAST_CORNERS) {
    drawn.push(place);
    view.sketch = { corners: drawn, isOpen: mode === 'wall', colour: 'keep out' };
  } else if (isSingle && mode === 'pan' && hasClicked(event)) {
    const region = view.regionAt(place);
    if (region !== null) chooseRegion(`${region}`);
  }
  view.redraw();
};
function hasClicked(event) {
  const [x, y] = placeOf(event);
  return Math.hypot(x - pressed[0], y - pressed[1]) < CLICK_PX;
}

function showPlace(x, y) {
  find('place').textContent = `x ${x.toFixed(2)}, y ${y.toFixed(2)} m`;
}

view.onscale = (scale) => {
  const metres = roundUp(60 / scale);
  find('scale').style.width = `${metres * scale}px`;
  find('scale').textContent = `${metres} m`;
};

canvas.onpointercancel = (event) => {
  pointers.delete(event.pointerId);
  if (view.sketch?.from) view.sketch = null;
};
canvas.onwheel = (event) => {
  event.preventDefault();
  view.zoom(Math.exp(-event.deltaY / 400), ...placeOf(event));
};

function pinch(id, before, now) {
  const [, other] = [...pointers].find(([key]) => key !== id);
  const distance = ([x, y]) => Math.max(Math.hypot(x - other[0], y - other[1]), 1);
  view.zoom(distance(now) / distance(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
}

function turn(now) {
  const { from } = view.sketch;
  const to = view.toMap(...now);
  const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
  if (Math.hypot(dx, dy) * view.scale < 8) return;
  view.sketch = { from, to, theta: Math.atan2(dy, dx) };
}

function finish() {
  const { from, theta } = view.sketch;
  view.sketch = null;
  const robot = items.get('robot')?.pose ?? [...from, 0];
  const ahead = mode === 'goal' ? Math.atan2(from[1] - robot[1], from[0] - robot[0]) : robot[2];
  ask(mode, { x: from[0], y: from[1], theta: theta ?? ahead });
  setMode('pan');
}

// The joystick: it drives while it is held, and only then.

let hold = null;
const stick = find('joystick');

function push(event) {
  const radius = stick.clientWidth / 2;
  const box = stick.getBoundingClientRect();
  let x = (event.clientX - box.left - radius) / radius;
  let y = (event.clientY - box.top - radius) / radius;
  const length = Math.max(Math.hypot(x, y), 1);
  [x, y] = [x / length, y / length];
  hold.ahead = -y;
  hold.left = -x;
  find('knob').style.transform = `translate(${x * radius * 0.7}px, ${y * radius * 0.7}px)`;
}

function drive() {
  if (!hold || items.get('held')) return;
  if (silentMs() > LATE_MS) say('the link is late: the joystick does not drive');
  else ask('drive', { ahead: hold.ahead, left: hold.left });
}

function release() {
  if (!hold) return;
  clearInterval(hold.timer);
  hold = null;
  find('knob').style.transform = '';
  if (socket?.readyState === WebSocket.OPEN) ask('drive', { ahead: 0, left: 0 });
}

stick.onpointerdown = (event) => {
  stick.setPointerCapture(event.pointerId);
  release();
  hold = { ahead: 0, left: 0, timer: setInterval(drive, DRIVE_PERIOD_MS) };
  push(event);
  drive();
};
stick.onpointermove = (event) => {
  if (hold) push(event);
};
stick.onpointerup = stick.onpointercancel = stick.onlostpointercapture = release;
addEventListener('blur', release);
addEventListener('pagehide', release);
document.addEventListener('visibilitychange', () => {
  if (document.hidden) release();
});

connect();
