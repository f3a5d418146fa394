// SPDX-License-Identifier: Apache-2.0
'use strict';

const $ = id => document.getElementById(id);
// The token comes in the fragment, which never leaves the browser, and is kept for this tab only.
const fragment = new URLSearchParams(location.hash.slice(1));
if (fragment.has('token')) {
  sessionStorage.setItem('token', fragment.get('token'));
  history.replaceState(null, '', location.pathname);
}
const token = sessionStorage.getItem('token') || '';
const TABS = ['roll', 'pitch', 'yaw', 'common'];
const LABELS = {
  disarm: 'Disarm', takeoff: 'Take off', step_roll: 'Step roll 10°', step_pitch: 'Step pitch 10°',
  autotune_roll: 'Roll', autotune_pitch: 'Pitch', autotune_yaw: 'Yaw', apply_proposal: 'Apply proposal',
};
const samples = [];
let gains = [], wanted = {}, tab = 'roll', dirty = true;

const degrees = 180 / Math.PI;
const angle = axis => [
  { colour: '--raw', width: 1, pick: s => s.raw[axis] * degrees, quiet: true },
  { colour: '--setpoint', width: 1.5, pick: s => s.setpoint[axis] * degrees },
  { colour: '--estimate', width: 2, pick: s => s.estimate[axis] * degrees },
];
const strips = [
  new Strip($('roll'), angle(0), { least: 6, unit: '°' }),
  new Strip($('pitch'), angle(1), { least: 6, unit: '°' }),
  new Strip($('pwm'), [0, 1, 2, 3].map(m => ({ colour: `--m${m + 1}`, width: 1.5, pick: s => s.pulses[m] })),
    { unit: '', bounds: [980, 2020] }),
];

function say(text, good = false) {
  $('message').textContent = text;
  $('message').className = good ? 'good' : '';
}

async function ask(path, body) {
  const options = { headers: { Authorization: `Bearer ${token}` } };
  if (body !== undefined) {
    options.method = 'POST';
    options.headers['Content-Type'] = 'application/json';
    options.body = JSON.stringify(body);
  }
  const response = await fetch(path, options);
  if (response.ok) return response;
  const { error } = await response.json();
  throw new Error(response.status === 401 ? 'Wrong token: open the link that the node printed.' : error);
}

async function run(work, done) {
  try {
    const result = await work();
    say(done || result || '', true);
  } catch (error) {
    say(error.message);
  }
}

const tabOf = name => TABS.find(axis => name.startsWith(`${axis}_`)) || 'common';
const shown = value => String(+value.toPrecision(6));

function build() {
  $('tabs').replaceChildren(...TABS.map(name => {
    const button = document.createElement('button');
    button.textContent = name[0].toUpperCase() + name.slice(1);
    button.setAttribute('role', 'tab');
    button.setAttribute('aria-selected', String(name === tab));
    button.onclick = () => { tab = name; build(); };
    return button;
  }));
  $('gains').replaceChildren(...gains.filter(g => tabOf(g.name) === tab).map(row));
  refresh();
}

function row(gain) {
  const box = document.createElement('div');
  box.className = 'gain';
  box.dataset.name = gain.name;
  const label = document.createElement('label');
  label.textContent = gain.name.replace(`${tab}_`, '').replaceAll('_', ' ');
  label.htmlFor = gain.name;
  const number = document.createElement('input');
  Object.assign(number, { id: gain.name, type: 'number', min: gain.minimum, max: gain.maximum, step: 'any' });
  const slider = document.createElement('input');
  // A cubic scale: useful values of a gain lie in the lower part of its range.
  Object.assign(slider, { type: 'range', min: 0, max: 1000, tabIndex: -1, ariaLabel: gain.name });
  const span = gain.maximum - gain.minimum;
  slider.oninput = () => {
    number.value = shown(gain.minimum + span * (slider.value / 1000) ** 3);
    number.oninput();
  };
  number.oninput = () => {
    const value = number.valueAsNumber;
    if (value === gain.value) delete wanted[gain.name]; else wanted[gain.name] = value;
    refresh();
  };
  number.onkeydown = event => { if (event.key === 'Enter') $('apply').click(); };
  const note = document.createElement('small');
  note.textContent = `${gain.text}${gain.unit && gain.unit !== '1' ? ` [${gain.unit}]` : ''}, ${shown(gain.minimum)} … ${shown(gain.maximum)}`;
  box.append(label, number, slider, note);
  return box;
}

function refresh() {
  for (const gain of gains) {
    const box = document.querySelector(`[data-name="${gain.name}"]`);
    if (!box) continue;
    const [number, slider] = box.querySelectorAll('input');
    const changed = gain.name in wanted;
    if (!changed && document.activeElement !== number) number.value = shown(gain.value);
    const value = changed ? wanted[gain.name] : gain.value;
    if (document.activeElement !== slider && Number.isFinite(value)) {
      slider.value = 1000 * Math.cbrt((value - gain.minimum) / (gain.maximum - gain.minimum));
    }
    box.classList.toggle('changed', changed);
  }
  const any = Object.keys(wanted).length > 0;
  $('apply').disabled = $('discard').disabled = !any;
}

function take(state) {
  const failsafe = state.arming.startsWith('failsafe');
  $('arming').textContent = state.arming;
  $('arming').className = `pill ${failsafe ? 'failsafe' : state.arming === 'armed' ? 'armed' : ''}`;
  $('trial').hidden = !state.trial;
  $('trial').textContent = state.trial || '';
  $('battery').textContent = state.voltage ? `${state.voltage.toFixed(1)} V` : '';
  $('rate').textContent = state.rate ? `${Math.round(state.rate)} Hz` : '';
  list('history', state.history.slice().reverse(), 'no change yet', entry => {
    const item = document.createElement('li');
    const by = document.createElement('span');
    by.className = 'by';
    by.textContent = entry.by;
    item.append(by, Object.entries(entry.changes).map(([n, [a, b]]) => `${n} ${shown(a)} → ${shown(b)}`).join(', '));
    return item;
  });
  $('undo').disabled = state.history.length === 0;
  list('events', state.events.slice().reverse(), 'nothing yet', text => {
    const item = document.createElement('li');
    item.textContent = text;
    if (/reverted|failsafe|refused|stopped/.test(text)) item.className = 'bad';
    else if (/kept|proposal|: armed/.test(text)) item.className = 'good';
    return item;
  });
}

const before = {};
function list(id, entries, empty, make) {
  const key = JSON.stringify(entries);
  if (before[id] === key) return;
  before[id] = key;
  if (entries.length) { $(id).replaceChildren(...entries.map(make)); return; }
  const item = document.createElement('li');
  item.className = 'empty';
  item.textContent = empty;
  $(id).replaceChildren(item);
}

function receive(message) {
  for (const [t, setpoint, estimate, raw, pulses] of message.samples) samples.push({ t, setpoint, estimate, raw, pulses });
  const newest = samples.length ? samples[samples.length - 1].t : 0;
  // A restarted simulation starts its time anew.
  if (samples.some(s => s.t > newest)) samples.splice(0, samples.length - 1);
  let old = 0;
  while (old < samples.length && samples[old].t < newest - WINDOW) old++;
  samples.splice(0, old);
  let moved = false;
  for (const gain of gains) {
    if (gain.value !== message.values[gain.name]) { gain.value = message.values[gain.name]; moved = true; }
  }
  if (moved) refresh();
  take(message);
  dirty = true;
}

function frame() {
  if (dirty) {
    dirty = false;
    for (const strip of strips) strip.draw(samples);
    const last = samples[samples.length - 1];
    if (last) for (const [i, name] of ['roll', 'pitch'].entries()) $(`now-${name}`).textContent = `${(Math.round(last.estimate[i] * degrees * 100) / 100 || 0).toFixed(2)}°`;
  }
  requestAnimationFrame(frame);
}

function connect() {
  const socket = new WebSocket(`${location.protocol === 'https:' ? 'wss' : 'ws'}://${location.host}/ws`, [`token.${token}`]);
  socket.onmessage = event => receive(JSON.parse(event.data));
  socket.onclose = () => {
    $('arming').textContent = 'no contact';
    $('arming').className = 'pill';
    setTimeout(connect, 1000);
  };
}

function apply(state) {
  gains = state.gains;
  wanted = {};
  build();
  take(state);
}

const post = path => body => ask(path, body).then(r => r.json()).then(apply);
$('apply').onclick = () => run(async () => {
  const bad = Object.keys(wanted).find(name => !Number.isFinite(wanted[name]));
  if (bad) throw new Error(`'${bad}' is no number`);
  await post('/api/gains')({ gains: wanted });
}, 'Applied.');
$('discard').onclick = () => { wanted = {}; document.activeElement.blur(); build(); say(''); };
$('undo').onclick = () => run(() => post('/api/undo')({}), 'Undone.');
$('save').onclick = () => run(async () => {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(await (await ask('/api/yaml')).blob());
  link.download = 'attitude_controller.yaml';
  link.click();
  URL.revokeObjectURL(link.href);
}, 'Saved.');
$('load').onchange = () => run(async () => {
  const [file] = $('load').files;
  $('load').value = '';
  await post('/api/yaml')({ yaml: await file.text() });
}, 'Loaded.');

function button(name) {
  const made = document.createElement('button');
  made.textContent = LABELS[name] || name;
  made.dataset.action = name;
  return made;
}

document.addEventListener('click', event => {
  const name = event.target.dataset && event.target.dataset.action;
  if (name) run(async () => (await (await ask('/api/action', { name })).json()).text);
});

run(async () => {
  const state = await (await ask('/api/state')).json();
  for (const name of state.actions) {
    if (name === 'kill') continue;
    const place = name.startsWith('autotune') || name === 'apply_proposal' ? 'autotune' : 'flight';
    $(place).append(button(name));
  }
  apply(state);
  connect();
  frame();
});
