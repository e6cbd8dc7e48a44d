// The page: a socket, what it brings, and what it asks for.

import { MapView } from './map.js';
import { Plot } from './plot.js';

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
const LEAST_CORNERS = { keep_out: 3, wall: 2, erase: 3 };
const items = new Map();
const find = (id) => document.getElementById(id);
const view = new MapView(find('map'), items);
const plots = {
  coverage: new Plot(find('plot-coverage'), 'coverage over path', '%'),
  step: new Plot(find('plot-step'), 'step of the localizer', 'ms'),
  inliers: new Plot(find('plot-inliers'), 'scan points on walls', '%'),
};
let socket = null;
let mode = 'pan';
let limit = [];
let drawn = []; // corners of what is being drawn: an area, a wall, a part to erase
const state = { isHeld: false, opened: performance.now(), heard: 0, link: '' };
window.thinmap = { items, view }; // for tests and the curious

function ask(action, values = {}) {
  // The newest beat says how old a request is when it arrives.
  const beat = items.get('beat');
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({ action, beat, ...values }));
  else say('not connected: nothing was sent');
}

function say(text) {
  find('news').textContent = text;
}

function showLink(text, isBad) {
  find('link').textContent = text;
  find('link').className = isBad ? 'bad' : '';
}

const silentMs = () => performance.now() - state.heard;

setInterval(() => {
  if (!state.link) return;
  const isLate = silentMs() > GONE_MS;
  showLink(isLate ? `late: nothing heard for ${Math.round(silentMs() / 1000)} s` : state.link, isLate);
}, LATE_MS);

function connect() {
  const scheme = location.protocol === 'https:' ? 'wss' : 'ws';
  socket = new WebSocket(`${scheme}://${location.host}/socket`);
  socket.onopen = () => socket.send(JSON.stringify({ token: location.hash.slice(1) }));
  socket.onmessage = (event) => JSON.parse(event.data).forEach(([name, value]) => take(name, value));
  socket.onclose = (event) => {
    release();
    const isRefused = event.code === 1008;
    state.link = '';
    showLink(isRefused ? event.reason || 'refused' : `${event.reason || 'lost'}: trying again`, true);
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
    showLink(state.link, false);
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
    find('slam-detail').textContent = `${slam.state}: ${slam.detail}`;
    const seconds = (performance.now() - state.opened) / 1000;
    plots.step.add(seconds, slam.step_ms);
    plots.inliers.add(seconds, 100 * slam.inliers);
  },
  exploration: (status) => {
    find('exploration-state').textContent = status.state;
    find('exploration-detail').textContent = status.detail;
    plots.coverage.add(status.distance, 100 * status.coverage);
  },
  news: ([, text]) => say(text),
  refused: say,
  held: (stop) => {
    const isHeld = stop > 0;
    state.isHeld = isHeld;
    find('stop').textContent = isHeld ? 'STOPPED' : 'STOP';
    find('stop').classList.toggle('held', isHeld);
    find('release').hidden = !isHeld;
  },
  held_by: (reason) => {
    find('held-by').textContent = reason;
  },
  regions: (regions) => {
    const chosen = find('regions').value;
    find('regions').replaceChildren(...regions.map((region) => new Option(region.name, region.id)));
    if (regions.some((region) => `${region.id}` === chosen)) find('regions').value = chosen;
  },
  sessions: (names) => {
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
  key: (key) => {
    find('key').replaceChildren(...Object.entries(key).map(([name, colour]) => {
      const line = document.createElement('li');
      const patch = document.createElement('i');
      patch.style.background = colour;
      line.append(patch, name);
      return line;
    }));
  },
};

async function showMerge({ state: stage, words, picture }) {
  find('merge-words').textContent = [stage, ...words].filter(Boolean).join('\n');
  find('merge').disabled = stage === 'working' || stage === 'shown';
  find('merged').hidden = stage !== 'shown';
  find('merge-drop').hidden = !find('merge').disabled;
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
  if (name !== 'beat') view.redraw();
}

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
for (const action of ['save', 'load']) find(action).onclick = () => ask(action, { name: find('name').value });
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
const canvas = find('map');
const placeOf = (event) => [event.offsetX, event.offsetY];

canvas.onpointerdown = (event) => {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, placeOf(event));
  hasPinched = pointers.size > 1;
  if (hasPinched) view.sketch = null;
  else if (mode === 'goal' || mode === 'initial_pose') {
    view.sketch = { from: view.toMap(...placeOf(event)), to: null };
  }
};
canvas.onpointermove = (event) => {
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
  }
  view.redraw();
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
  if (!hold || state.isHeld) return;
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
