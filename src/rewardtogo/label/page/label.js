// The labelling page: shows an observation, sends an answer, and shows what the server gives back with it.

import { $, Controls, ask, described, draw, table, tell, token } from "/shared.js";

const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
let setup = null;      // what does not change
let controls = null;   // of the actions
let view = null;       // what the server said last
let busy = false;
let film = 0;          // the timer of the moments before

function who() { return $("who").value.trim() || "me"; }

const say = (path, body) => ask(path, body && { by: who(), ...body }, "Every label so far is kept");

async function act(request) {
  if (busy) return;
  busy = true;
  try { show(await request()); }
  catch (error) {
    tell(error.message, true);
    if (error.status === 409) setTimeout(() => load(), 500);
  } finally { busy = false; }
}

const load = (at) => act(() => say(`/api/item?by=${encodeURIComponent(who())}${at === undefined ? "" : `&at=${at}`}`));
const send = (what) => view && view.item && act(() => say("/api/answer", { round: view.round, item: view.item.index, ...what }));
const undo = () => view && act(() => say("/api/answer", { round: view.round, undo: true }));
const back = () => view && load(Math.max(0, (view.item ? view.item.index : view.progress.size) - 1));

// --- actions ---------------------------------------------------------------------------------------------------

function preset(item) {
  const mine = item && item.answered && item.mine !== "skip" ? item.mine : null;
  controls.enable(Boolean(item), item && item.allowed, controls.discrete ? mine : null);
  if (!controls.discrete) controls.put(mine === null ? controls.middle() : [mine].flat(Infinity));
}

const named = (action) => action === "skip" ? "skipped" : controls.named(action);

// --- what is seen -----------------------------------------------------------------------------------------------

const frame = (index) => `/frame/${view.round}/${index}.png?token=${encodeURIComponent(token)}`;

function motion(item) {
  clearInterval(film);
  const moments = [...item.before, item.index];
  if (!item.picture) { draw(item); return; }
  const picture = $("picture");
  picture.alt = described(`Observation ${item.index} of round ${view.round}`, item.numbers);
  if (still || moments.length < 2) { picture.src = frame(item.index); return; }
  let at = 0;
  picture.src = frame(moments[0]);
  film = setInterval(() => {
    at += 1;
    picture.src = frame(moments[at]);
    if (at === moments.length - 1) clearInterval(film);
  }, 60);
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
  try { await say("/api/finish", { round: view.round }); await load(); } catch (error) { tell(error.message, true); }
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
  if (!controls) return;
  if (controls.discrete && key in controls.keys) {
    event.preventDefault();
    const choice = controls.keys[key];
    if (view && view.item && !(view.item.allowed && !view.item.allowed[choice])) send({ action: choice });
  } else if (!controls.discrete && key === "Enter" && !(event.target instanceof HTMLButtonElement)) {
    event.preventDefault();
    send({ action: controls.shaped() });
  }
});
setInterval(() => {
  // While nothing can be answered here, things change elsewhere.
  if (view && !busy && (view.status === "training" || (view.status === "labelling" && !view.item))) load();
}, 400);

(async () => {
  $("who").value = localStorage.getItem("who") || "me";
  try {
    setup = await say("/api/setup");
    $("title").textContent = `Label ${setup.env}`;
    document.title = `Label ${setup.env}`;
    controls = new Controls($("actions"), setup.action, (action) => send({ action }));
    const slider = $("actions").querySelector("input");
    if (slider) slider.focus();
    await load();
  } catch (error) { tell(error.message, true); }
})();
