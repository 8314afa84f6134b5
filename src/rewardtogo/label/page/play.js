// The page to play on: keeps the time, sends an action for each step, and shows what the server gives back with it.

import { $, Controls, ask, described, draw, table, tell } from "/shared.js";

const WORDS = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down" };
const TRAIL = 8;       // moments before the present one that are shown
const RATES = [2, 5, 10, 15, 20, 30, 50];
const me = sessionStorage.getItem("tab") || crypto.getRandomValues(new Uint32Array(4)).join("-");
sessionStorage.setItem("tab", me);

let setup = null;      // what does not change
let controls = null;   // of the actions
let view = null;       // what the server said last
let trail = [];        // the numbers of the moments before
let running = false;   // whether time runs by itself
let last = 0;          // the action that was taken last
let fault = null;      // what went wrong last, until something goes right
let asked = 0;         // when the server was asked last
const held = [];       // the keys that are down, the one pressed last at the end
let tapped = null;     // a key (or a button's number) that was pressed since the last step, perhaps released again
let pressed = null;    // the number of the button that is held down

// --- one request after another ---------------------------------------------------------------------------------

let chain = Promise.resolve();
let waiting = 0;

function request(make) {
  waiting += 1;
  chain = chain.then(async () => {
    try {
      const found = make();
      if (!found) return;
      asked = performance.now();
      const data = await found;
      // An answer to a mere look shows only that the server is there again.
      if (fault && (fault.lost || data.step !== view.step)) fault = null;
      show(data);
    } catch (error) {
      running = false;
      fault = { text: error.message, lost: error.status === undefined };
      if (error.status === 409) setTimeout(load, 200);
      if (view) texts(); else tell(error.message, true);
    } finally { waiting -= 1; }
  });
  return chain;
}

const post = (path, body) => ask(path, { by: me, ...body }, "Every episode that was kept is on the disk");
const load = () => request(() => ask(`/api/view?by=${encodeURIComponent(me)}`, undefined, "Every episode that was kept is on the disk"));
const playable = () => view && view.status === "playing" && !view.over;
const send = (body) => post("/api/act", { attempt: view.attempt, step: view.step, ...body });

function act(action) {
  return request(() => {
    if (!playable() || (controls.discrete && view.allowed && !view.allowed[action])) return null;
    last = action;
    return send({ action });
  });
}

function what(word, possible) {
  running = false;
  release();
  return request(() => (view && view.status === "playing" && possible() ? send({ what: word }) : null));
}

const discard = () => what("discard", () => view.step || view.over);
const keep = () => what("keep", () => !view.over && view.step);
const next = () => what("begin", () => view.over && view.kept < view.episodes);

// --- time ------------------------------------------------------------------------------------------------------

const rate = () => Number($("rate").value);

function release() { held.length = 0; tapped = pressed = null; }

// The action of the keys that are held; several arrows may have an action of their own, such as "up left".
function choice(keys) {
  if (typeof keys[0] === "number") return keys[0];
  const words = keys.filter((key) => key in WORDS).map((key) => WORDS[key]).sort().join(" ");
  const together = words.includes(" ") ? setup.action.names.findIndex((name) => name.split(" ").sort().join(" ") === words) : -1;
  return together >= 0 ? together : controls.keys[keys[keys.length - 1]];
}

// The discrete action where no key is held; undefined where time waits.
function idle() {
  const neutral = $("neutral").value;
  return neutral === "wait" ? undefined : neutral === "last" ? last : Number(neutral);
}

// What acts in the next step; undefined where it waits.
function chosen() {
  const keys = held.length ? held : tapped === null ? [] : [tapped];
  tapped = null;
  if (controls.discrete) {
    const found = pressed !== null ? pressed : keys.length ? choice(keys) : idle();
    return view.allowed && found !== undefined && !view.allowed[found] ? undefined : found;
  }
  const values = [...controls.values];
  for (const key of keys) {
    const entry = values.length > 1 && (key === "ArrowUp" || key === "ArrowDown") ? 1 : 0;
    const low = setup.action.low[entry] ?? -1, high = setup.action.high[entry] ?? 1;
    values[entry] = key === "ArrowRight" || key === "ArrowUp" ? high : low;
  }
  controls.put(values, false);
  return controls.shaped(values);
}

async function run() {
  if (running || !playable() || !rate()) return;
  running = true;
  texts();
  let due = performance.now();
  while (running && playable()) {
    const action = chosen();
    if (action !== undefined) await act(action);
    due = Math.max(due + 1000 / rate(), performance.now());
    await new Promise((done) => setTimeout(done, due - performance.now()));
  }
  running = false;
  texts();
}

function pause() {
  if (!running) return;
  running = false;
  release();
  texts();
}

// --- what is seen ----------------------------------------------------------------------------------------------

const short = (x) => (Number.isInteger(x) ? String(x) : x.toFixed(2));

function show(data) {
  const before = view;
  view = data;
  if (data.status === "playing") {
    if (!before || before.status !== "playing" || before.attempt !== data.attempt) trail = [];
    else if (data.step > before.step) trail = [...trail, before.numbers.map((n) => n.value)].slice(-TRAIL);
    if (!before || before.attempt !== data.attempt) release();
    seen(data);
  }
  if (data.kept !== undefined) counts(data);
  if (data.over || data.status !== "playing") { running = false; release(); }
  texts();
}

function seen(data) {
  const picture = $("picture");
  picture.hidden = !data.picture;
  $("plot").hidden = Boolean(data.picture) || !data.numbers.length;
  if (data.picture) {
    picture.src = data.picture;
    picture.alt = described(`${setup.env}, step ${data.step}`, data.numbers);
  } else draw({ numbers: data.numbers, trail });
  table({ numbers: data.numbers, trail, picture: data.picture });
  $("step").textContent = data.step;
  $("total").textContent = short(data.total);
}

function counts(data) {
  $("bar").max = data.episodes;
  $("bar").value = data.kept;
  $("count").textContent = `${data.kept} of ${data.episodes}`;
  $("mean").textContent = data.return_mean === null ? "–" : short(data.return_mean);
  $("recent").hidden = !data.recent.length;
  const body = $("recent").querySelector("tbody");
  body.replaceChildren();
  for (const row of data.recent) {
    const line = body.insertRow();
    for (const text of [row.episode, row.steps, short(row.total)]) line.insertCell().textContent = text;
  }
}

const ENDS = { terminated: "has ended", truncated: "has reached its time limit", cut: "was cut here" };

function texts() {
  const on = Boolean(playable()), timed = rate() > 0, over = view.status === "playing" && view.over;
  const complete = over && view.kept >= view.episodes;
  let title, note = "";
  if (view.status === "done") {
    title = "Done.";
    note = `${view.kept} ${view.kept === 1 ? "episode is" : "episodes are"} in ${setup.dataset}. You can close this page.`;
  } else if (view.status === "failed") {
    title = "The environment failed.";
    note = `${view.message}. Every episode that was kept is on the disk.`;
  } else if (view.status === "taken") {
    title = "This is being played in another tab.";
    note = "One can play at a time.";
  } else if (over) {
    title = `Episode ${view.kept} ${ENDS[view.over]}, and is kept.`;
    note = complete
      ? `That was the last one: it finishes in ${Math.ceil(view.waits ?? setup.pause)} s. X throws it away.`
      : "Enter begins the next one. X throws this one away.";
  } else if (!timed) {
    title = "What do you do?";
    note = view.step ? "X throws the episode away, K ends it here and keeps it." : "Nothing happens until you choose.";
  } else if (running) {
    title = "Playing…";
    note = "X throws the episode away, K ends it here and keeps it.";
  } else {
    title = view.step ? "Paused." : "Ready.";
    note = `Space or an action ${view.step ? "goes on" : "starts it"}.`;
  }
  if ($("question").textContent !== title) $("question").textContent = title;
  if (view.status !== "playing") fault = null;
  tell(fault ? fault.text : note, Boolean(fault));
  document.body.dataset.status = view.status;
  document.body.dataset.time = timed ? "runs" : "waits";
  $("which").textContent = view.status === "playing" ? `Episode ${over ? view.kept : view.kept + 1} of ${view.episodes}` : "";
  $("pace").textContent = !on ? "" : !timed ? "waits for you" : running ? `${rate()} steps a second` : "paused";
  $("seat").hidden = view.status !== "taken";
  $("start").disabled = !on || !timed;
  $("start").firstElementChild.textContent = running ? "Pause" : view.step ? "Go on" : "Start";
  $("next").disabled = !over || complete;
  $("discard").disabled = !(over || (on && view.step));
  $("keep").disabled = !on || !view.step;
  $("finish").disabled = view.status !== "playing" || !view.kept;
  $("neutral").disabled = !timed;
  const acts = !controls.discrete ? null : pressed !== null ? pressed : held.length ? choice(held) : running ? idle() : null;
  controls.enable(on, on ? view.allowed : null, acts);
}

// --- hands -----------------------------------------------------------------------------------------------------

function down(key) {
  if (!playable()) return;
  if (!rate()) {
    if (controls.discrete) act(choice([key]));
    return;
  }
  if (!held.includes(key)) held.push(key);
  tap(key);
}

function tap(what) {
  tapped = what;
  texts();
  run();
}

function space() { if (view && view.over) next(); else if (running) pause(); else run(); }

function enter() {
  if (view && view.over) next();
  else if (!rate() && !controls.discrete && playable()) act(controls.shaped());
  else run();
}

const plain = { " ": space, Enter: enter, x: discard, k: keep, 0: () => !controls.discrete && controls.put(controls.middle()) };
const pushes = (key) => !controls.discrete && setup.action.kind === "box" && rate() > 0 && key in WORDS;

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || !controls || !view) return;
  const target = event.target instanceof Element ? event.target : document.body;
  const field = target.closest("input, select");
  if (field && field.type !== "range") return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if ((key === " " || key === "Enter") && target.matches("button:focus-visible")) return;
  if (!(key in plain) && !(controls.discrete ? key in controls.keys : pushes(key))) return;
  event.preventDefault();
  if (event.repeat) return;
  if (key in plain) plain[key](); else down(key);
});
document.addEventListener("keyup", (event) => {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key, at = held.indexOf(key);
  if (at < 0) return;
  held.splice(at, 1);
  texts();
});
window.addEventListener("blur", pause);
document.addEventListener("visibilitychange", () => document.hidden && pause());

$("start").addEventListener("click", () => (running ? pause() : run()));
$("next").addEventListener("click", next);
$("discard").addEventListener("click", discard);
$("keep").addEventListener("click", keep);
$("centre").addEventListener("click", () => controls.put(controls.middle()));
$("seat").addEventListener("click", () => request(() => post("/api/seat", {})));
$("rate").addEventListener("change", () => { pause(); $("rate").blur(); texts(); });
$("neutral").addEventListener("change", () => $("neutral").blur());
$("finish").addEventListener("click", () => {
  pause();
  if (playable() && view.step && !confirm("The episode in progress is not kept, and will be thrown away. Finish?")) return;
  what("finish", () => true);
});
setInterval(() => {
  // While nobody acts here things may change elsewhere, and the server is told that this tab is still open.
  if (view && !waiting && performance.now() - asked > 900 && view.status !== "done" && view.status !== "failed") load();
}, 1000);

function build() {
  controls = new Controls(
    $("actions"),
    setup.action,
    (action, pointed) => {
      if (!controls.discrete || !rate()) act(action);
      else if (!pointed) tap(action);
    },
    (number, on) => {
      if (!rate() || !playable()) return;
      pressed = on ? number : null;
      if (on) tap(number); else texts();
    },
  );
  for (const value of [...new Set([0, ...RATES, setup.rate])].sort((a, b) => a - b)) {
    $("rate").add(new Option(value ? `${value} steps a second` : "waits for each action", String(value)));
  }
  $("rate").value = String(setup.rate);
  $("hint").hidden = controls.discrete;
  $("neutral").hidden = document.querySelector("label[for=neutral]").hidden = !controls.discrete;
  if (!controls.discrete) {
    controls.put(controls.middle());
    const name = (i) => setup.action.names[i] || (setup.action.low.length > 1 ? `entry ${i}` : "it");
    $("push").textContent = setup.action.kind !== "box" ? "" : `Arrows push ${name(0)}${setup.action.low.length > 1 ? ` (← →) and ${name(1)} (↑ ↓)` : ""} to the end.`;
    return;
  }
  for (let i = 0; i < setup.action.counts[0]; i++) $("neutral").add(new Option(controls.name(i), String(i)));
  $("neutral").add(new Option("the last action again", "last"));
  $("neutral").add(new Option("time waits", "wait"));
  $("neutral").value = String(setup.neutral);
}

(async () => {
  try {
    setup = await ask("/api/setup", undefined, "Every episode that was kept is on the disk");
    $("title").textContent = document.title = `Play ${setup.env}`;
    $("where").textContent = setup.dataset;
    build();
    await load();
  } catch (error) { tell(error.message, true); }
})();
