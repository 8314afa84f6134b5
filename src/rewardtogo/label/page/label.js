"use strict";
// The labelling page: shows an observation, sends an answer, and shows what the server gives back with it.

const $ = (id) => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token") || "";
const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
let setup = null;      // what does not change
let view = null;       // what the server said last
let busy = false;
let film = 0;          // the timer of the moments before
let values = [];       // of an action with several entries

function who() { return $("who").value.trim() || "me"; }

async function ask(path, body) {
  const options = { headers: { "X-Token": token } };
  if (body !== undefined) {
    options.method = "POST";
    options.headers["Content-Type"] = "application/json";
    options.body = JSON.stringify({ by: who(), ...body });
  }
  let reply;
  try { reply = await fetch(path, options); }
  catch { throw new Error("The server does not answer. Every label so far is kept: start it again, and open the address that it prints."); }
  const data = await reply.json();
  if (!reply.ok) throw Object.assign(new Error(data.error), { status: reply.status });
  return data;
}

function tell(text, bad = false) {
  $("message").textContent = text;
  $("message").classList.toggle("bad", bad);
}

async function act(request) {
  if (busy) return;
  busy = true;
  try { show(await request()); }
  catch (error) {
    tell(error.message, true);
    if (error.status === 409) setTimeout(() => load(), 500);
  } finally { busy = false; }
}

const load = (at) => act(() => ask(`/api/item?by=${encodeURIComponent(who())}${at === undefined ? "" : `&at=${at}`}`));
const send = (what) => view && view.item && act(() => ask("/api/answer", { round: view.round, item: view.item.index, ...what }));
const undo = () => view && act(() => ask("/api/answer", { round: view.round, undo: true }));
const back = () => view && load(Math.max(0, (view.item ? view.item.index : view.progress.size) - 1));

// --- actions ---------------------------------------------------------------------------------------------------

const ARROWS = { left: "ArrowLeft", right: "ArrowRight", up: "ArrowUp", down: "ArrowDown" };
const SIGNS = { ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓" };
let keys = {};         // key -> choice

function build() {
  const action = setup.action, form = $("actions");
  form.replaceChildren();
  keys = {};
  if (action.kind === "discrete") {
    for (let i = 0; i < action.counts[0]; i++) {
      const button = document.createElement("button"), name = action.names[i] || `action ${i}`;
      const arrow = ARROWS[name];
      const key = arrow || (i < 9 ? String(i + 1) : "");
      if (i < 9) keys[String(i + 1)] = i;
      if (arrow) keys[arrow] = i;
      button.type = "button";
      button.className = "choice";
      button.dataset.choice = i;
      button.append(name);
      if (key) { const k = document.createElement("kbd"); k.textContent = arrow ? SIGNS[arrow] : key; button.append(k); }
      button.addEventListener("click", () => send({ action: i }));
      form.append(button);
    }
    return;
  }
  const count = action.counts.length && action.kind !== "box" ? action.counts.length : action.low.length;
  values = Array(count).fill(0);
  for (let i = 0; i < count; i++) {
    const row = document.createElement("div"), id = `entry-${i}`, label = document.createElement("label");
    row.className = "entry";
    label.htmlFor = id;
    label.textContent = action.names[i] || (count > 1 ? `entry ${i}` : "action");
    row.append(label);
    if (action.kind === "box") {
      const low = action.low[i], high = action.high[i], number = document.createElement("input");
      number.type = "number"; number.step = "any"; number.setAttribute("aria-label", `${label.textContent}, exactly`);
      if (low !== null && high !== null) {
        const slider = document.createElement("input");
        Object.assign(slider, { type: "range", id, min: low, max: high, step: (high - low) / 200 });
        number.min = low; number.max = high;
        slider.addEventListener("input", () => { values[i] = Number(slider.value); number.value = slider.value; });
        number.addEventListener("input", () => { values[i] = Number(number.value); slider.value = number.value; });
        row.append(slider, number);
      } else {
        number.id = id;
        number.addEventListener("input", () => { values[i] = Number(number.value); });
        row.append(number);
      }
    } else {
      const select = document.createElement("select");
      select.id = id;
      for (let c = 0; c < action.counts[i]; c++) select.add(new Option(String(c), String(c)));
      select.addEventListener("change", () => { values[i] = Number(select.value); });
      row.append(select);
    }
    form.append(row);
  }
  const button = document.createElement("button"), k = document.createElement("kbd");
  button.type = "submit"; button.className = "choice"; k.textContent = "Enter";
  button.append("This action", k);
  form.append(button);
}

function shaped(flat) {
  const nest = (shape, take) => shape.length ? Array.from({ length: shape[0] }, () => nest(shape.slice(1), take)) : take();
  let i = 0;
  return nest(setup.action.shape, () => flat[i++]);
}

function preset(item) {
  if (setup.action.kind === "discrete") {
    for (const button of $("actions").querySelectorAll(".choice")) {
      const choice = Number(button.dataset.choice);
      button.disabled = Boolean(item && item.allowed && !item.allowed[choice]) || !item;
      button.setAttribute("aria-pressed", String(Boolean(item) && item.mine === choice));
    }
    return;
  }
  const middle = setup.action.low.map((low, i) => low === null || setup.action.high[i] === null ? 0 : (low + setup.action.high[i]) / 2);
  const given = item && item.answered && item.mine !== "skip" ? [item.mine].flat(Infinity) : setup.action.kind === "box" ? middle : values.map(() => 0);
  values = given.map(Number);
  $("actions").querySelectorAll(".entry").forEach((row, i) => {
    for (const input of row.querySelectorAll("input, select")) { input.value = Number(values[i].toPrecision(6)); input.disabled = !item; }
  });
  $("actions").querySelector(".choice").disabled = !item;
}

const named = (action) => action === "skip" ? "skipped"
  : setup.action.kind === "discrete" ? (setup.action.names[action] || `action ${action}`)
  : [action].flat(Infinity).map((x) => setup.action.kind === "box" ? x.toFixed(2) : x).join(", ");

// --- what is seen -----------------------------------------------------------------------------------------------

const frame = (index) => `/frame/${view.round}/${index}.png?token=${encodeURIComponent(token)}`;

function motion(item) {
  clearInterval(film);
  const moments = [...item.before, item.index];
  if (!item.picture) { draw(item); return; }
  const picture = $("picture");
  picture.alt = `Observation ${item.index} of round ${view.round}` + (item.numbers.length ? `: ${item.numbers.map((n) => `${n.name} ${n.value.toFixed(3)}`).join(", ")}` : "");
  if (still || moments.length < 2) { picture.src = frame(item.index); return; }
  let at = 0;
  picture.src = frame(moments[0]);
  film = setInterval(() => {
    at += 1;
    picture.src = frame(moments[at]);
    if (at === moments.length - 1) clearInterval(film);
  }, 60);
}

function draw(item) {
  // Each number over the last moments, the present one at the right.
  const canvas = $("plot"), pen = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(name).trim();
  const lines = Math.max(1, item.numbers.length), height = Math.max(56, Math.min(110, 420 / lines));
  const scale = devicePixelRatio || 1, width = canvas.clientWidth || 640;
  canvas.width = width * scale; canvas.height = height * lines * scale;
  pen.scale(scale, scale);
  pen.font = "13px system-ui, 'DejaVu Sans', sans-serif";
  item.numbers.forEach((n, row) => {
    const top = row * height + 22, bottom = (row + 1) * height - 8;
    const y = (value) => bottom - (Math.min(Math.max(value, n.low), n.high) - n.low) / (n.high - n.low) * (bottom - top);
    const x = (i) => 16 + i * (width - 40) / 8;
    pen.fillStyle = color("--quiet");
    pen.fillText(`${n.name}   ${n.value.toFixed(3)}`, 16, row * height + 15);
    pen.strokeStyle = color("--line");
    pen.lineWidth = 1;
    pen.strokeRect(10, top - 3, width - 20, bottom - top + 6);
    const trail = [...item.trail.map((t) => t[row]), n.value], first = 9 - trail.length;
    pen.strokeStyle = color("--trail"); pen.lineWidth = 2; pen.beginPath();
    trail.forEach((value, i) => i ? pen.lineTo(x(first + i), y(value)) : pen.moveTo(x(first), y(value)));
    pen.stroke();
    pen.fillStyle = color("--accent");
    pen.beginPath(); pen.arc(x(8), y(n.value), 5, 0, 7); pen.fill();
  });
  canvas.setAttribute("aria-label", item.numbers.map((n) => `${n.name} ${n.value.toFixed(3)}`).join(", "));
}

function table(item) {
  const body = $("numbers").tBodies[0];
  body.replaceChildren();
  $("numbers").hidden = !item.picture || !item.numbers.length;
  if ($("numbers").hidden) return;
  const NS = "http://www.w3.org/2000/svg";
  item.numbers.forEach((n, row) => {
    const line = body.insertRow(), head = document.createElement("th");
    head.scope = "row"; head.textContent = n.name;
    line.append(head);
    const cell = line.insertCell(); cell.className = "scale";
    const svg = document.createElementNS(NS, "svg");
    svg.setAttribute("viewBox", "0 0 200 16"); svg.setAttribute("preserveAspectRatio", "none"); svg.setAttribute("aria-hidden", "true");
    const x = (value) => 4 + 192 * (Math.min(Math.max(value, n.low), n.high) - n.low) / (n.high - n.low);
    const part = (kind, values) => { const e = document.createElementNS(NS, kind); for (const [k, v] of Object.entries(values)) e.setAttribute(k, v); svg.append(e); };
    part("rect", { x: 4, y: 7, width: 192, height: 2, fill: "var(--line)" });
    item.trail.forEach((t, i) => part("rect", { x: x(t[row]) - 1.5, y: 4, width: 3, height: 8, fill: "var(--trail)", opacity: (i + 1) / (item.trail.length + 1) }));
    part("rect", { x: x(n.value) - 2, y: 1, width: 4, height: 14, fill: "var(--accent)" });
    cell.append(svg);
    const value = line.insertCell(); value.className = "value"; value.textContent = n.value.toFixed(3);
  });
}

function show(data) {
  view = data;
  const item = data.item, progress = data.progress;
  if (data.status === "done") {
    clearInterval(film);
    $("question").textContent = "All rounds are done.";
    tell(`The policy is trained, in ${setup.run}. You can close this page.`);
  } else if (data.status === "training") {
    $("question").textContent = `Learning from round ${data.round + 1 > data.rounds ? data.rounds : data.round + 1}…`;
    tell("The next observations come when it is done.");
  } else if (item) {
    $("question").textContent = "What should be done here?";
    tell(data.waits !== null && data.waits !== undefined ? "Every observation of this round is answered." : "");
  } else if (data.waits !== null && data.waits !== undefined) {
    $("question").textContent = "Every observation of this round is answered.";
    tell(`Training begins in ${Math.ceil(data.waits)} s. Undo stops it; “Train now” begins at once.`);
  } else {
    $("question").textContent = "Nothing waits for you.";
    tell("Others are looking at the rest.");
  }
  document.body.dataset.status = data.status;
  $("where").textContent = setup.run;
  $("round").textContent = `${Math.min(data.round, data.rounds)} of ${data.rounds}`;
  if (progress) {
    $("bar").max = progress.size;
    $("bar").value = progress.done;
    $("count").textContent = `${progress.done} of ${progress.size} answered`;
    $("passed").textContent = progress.passed ? `${progress.passed} skipped` : "";
    $("agreement").textContent = progress.agreement === null ? "–" : `${Math.round(100 * progress.agreement)} %`;
    $("disputed").textContent = progress.disputed;
    $("labellers").textContent = Object.entries(progress.answers).map(([name, n]) => `${name} ${n}`).join(", ") || "–";
  }
  for (const id of ["back", "undo", "skip", "forth", "finish"]) $(id).disabled = data.status !== "labelling";
  $("skip").disabled = $("replay").disabled = !item;
  $("finish").disabled = !(progress && progress.labelled);
  $("undo").disabled = !(progress && progress.answers[who()]);
  preset(item);
  results(data.results);
  said(data.last || (item && item.answered ? item : null));
  $("which").textContent = item ? `Observation ${item.index + 1} of ${progress.size}` : "";
  if (!item) return;
  $("picture").hidden = !item.picture;
  $("plot").hidden = item.picture || !item.numbers.length;
  table(item);
  motion(item);
  // The next one is likely to be asked for: its picture can come meanwhile.
  if (item.picture && progress && item.index + 1 < progress.size) new Image().src = frame(item.index + 1);
}

function said(item) {
  $("said").hidden = !item;
  if (!item) return;
  const others = Object.entries(item.others).map(([name, a]) => `${name}: ${named(a)}`);
  const same = Object.values(item.others).every((a) => JSON.stringify(a) === JSON.stringify(item.mine));
  $("said").textContent = `Observation ${item.index + 1}: you ${item.mine === "skip" ? "skipped" : `said ${named(item.mine)}`}; the policy would do ${named(item.policy)}.`
    + (others.length ? ` ${same ? "Agreed" : "Disagreement"} — ${others.join(", ")}.` : "");
  $("said").classList.toggle("bad", others.length > 0 && !same);
}

function results(rows) {
  $("results").hidden = !rows.length;
  const body = $("results").querySelector("tbody");
  body.replaceChildren();
  for (const row of rows) {
    const line = body.insertRow(), box = setup.action.kind === "box";
    for (const text of [row.iteration, row.labels, box ? `error ${row.mistakes.toFixed(3)}` : `${Math.round(100 * (1 - row.mistakes))} %`, row.eval_return_mean === undefined ? "–" : row.eval_return_mean.toFixed(1)]) line.insertCell().textContent = text;
  }
}

// --- hands -------------------------------------------------------------------------------------------------------

$("back").addEventListener("click", back);
$("undo").addEventListener("click", undo);
$("skip").addEventListener("click", () => send({ skip: true }));
$("forth").addEventListener("click", () => load());
$("replay").addEventListener("click", () => view && view.item && motion(view.item));
$("finish").addEventListener("click", async () => {
  const open = view.progress.size - view.progress.done;
  if (open && !confirm(`${open} observations have no answer yet and will be left out. Train now?`)) return;
  try { await ask("/api/finish", { round: view.round }); await load(); } catch (error) { tell(error.message, true); }
});
$("actions").addEventListener("submit", (event) => {
  event.preventDefault();
  if (setup.action.kind !== "discrete") send({ action: shaped(values) });
});
$("who").addEventListener("change", () => { localStorage.setItem("who", who()); load(); });
document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  const field = event.target instanceof Element && event.target.closest("input, select");
  const sliding = field && field.type === "range";
  if (field && !sliding) return;
  const plain = { u: undo, b: back, s: () => send({ skip: true }), n: () => load(), r: () => view && view.item && motion(view.item) };
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  if (key in plain) { event.preventDefault(); plain[key](); return; }
  if (setup && setup.action.kind === "discrete" && key in keys) {
    event.preventDefault();
    if (view && view.item && !(view.item.allowed && !view.item.allowed[keys[key]])) send({ action: keys[key] });
  } else if (setup && setup.action.kind !== "discrete" && key === "Enter" && !(event.target instanceof HTMLButtonElement)) {
    event.preventDefault();
    send({ action: shaped(values) });
  }
});
setInterval(() => {
  // While nothing can be answered here, things change elsewhere.
  if (view && !busy && (view.status === "training" || (view.status === "labelling" && !view.item))) load();
}, 400);

(async () => {
  $("who").value = localStorage.getItem("who") || "me";
  try {
    setup = await ask("/api/setup");
    $("title").textContent = `Label ${setup.env}`;
    document.title = `Label ${setup.env}`;
    build();
    const slider = $("actions").querySelector("input");
    if (slider) slider.focus();
    await load();
  } catch (error) { tell(error.message, true); }
})();
