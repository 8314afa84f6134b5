// What both pages are made of: asking the server, the controls of actions, and how an observation is shown.

export const $ = (id) => document.getElementById(id);
export const token = new URLSearchParams(location.search).get("token") || "";

export async function ask(path, body, lost) {
  const options = { headers: { "X-Token": token } };
  if (body !== undefined) {
    options.method = "POST";
    options.headers["Content-Type"] = "application/json";
    options.body = JSON.stringify(body);
  }
  let reply;
  try { reply = await fetch(path, options); }
  catch { throw new Error(`The server does not answer. ${lost}: start it again, and open the address that it prints.`); }
  const data = await reply.json();
  if (!reply.ok) throw Object.assign(new Error(data.error), { status: reply.status });
  return data;
}

export function tell(text, bad = false) {
  $("message").textContent = text;
  $("message").classList.toggle("bad", bad);
}

// --- actions ---------------------------------------------------------------------------------------------------

const ARROWS = { left: "ArrowLeft", right: "ArrowRight", up: "ArrowUp", down: "ArrowDown" };
const SIGNS = { ArrowLeft: "←", ArrowRight: "→", ArrowUp: "↑", ArrowDown: "↓" };

// Buttons for discrete actions, sliders for boxes, lists for the rest. `choose(action, pointed)`: one was clicked (by a
// pointer, or by a key on it) or sent; `hold(choice, down)`: a button is held down, or no longer.
export class Controls {
  constructor(form, action, choose, hold = () => {}) {
    Object.assign(this, { form, action, choose, hold, keys: {}, values: [] });
    form.replaceChildren();
    if (action.kind === "discrete") this.buttons(); else this.entries();
    form.addEventListener("submit", (event) => {
      event.preventDefault();
      if (!this.discrete) choose(this.shaped());
    });
  }

  get discrete() { return this.action.kind === "discrete"; }

  name(choice) { return this.action.names[choice] || `action ${choice}`; }

  buttons() {
    for (let i = 0; i < this.action.counts[0]; i++) {
      const button = document.createElement("button"), arrow = ARROWS[this.name(i)];
      const key = arrow || (i < 9 ? String(i + 1) : "");
      if (i < 9) this.keys[String(i + 1)] = i;
      if (arrow) this.keys[arrow] = i;
      button.type = "button";
      button.className = "choice";
      button.dataset.choice = i;
      button.append(this.name(i));
      if (key) { const k = document.createElement("kbd"); k.textContent = arrow ? SIGNS[arrow] : key; button.append(k); }
      button.addEventListener("click", (event) => this.choose(i, event.detail > 0));
      button.addEventListener("pointerdown", () => this.hold(i, true));
      for (const end of ["pointerup", "pointerleave", "pointercancel"]) button.addEventListener(end, () => this.hold(i, false));
      this.form.append(button);
    }
  }

  entries() {
    const action = this.action, count = action.kind === "box" ? action.low.length : action.counts.length;
    this.values = Array(count).fill(0);
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
          slider.addEventListener("input", () => { this.values[i] = Number(slider.value); number.value = slider.value; });
          number.addEventListener("input", () => { this.values[i] = Number(number.value); slider.value = number.value; });
          row.append(slider, number);
        } else {
          number.id = id;
          number.addEventListener("input", () => { this.values[i] = Number(number.value); });
          row.append(number);
        }
      } else {
        const select = document.createElement("select");
        select.id = id;
        for (let c = 0; c < action.counts[i]; c++) select.add(new Option(String(c), String(c)));
        select.addEventListener("change", () => { this.values[i] = Number(select.value); });
        row.append(select);
      }
      this.form.append(row);
    }
    const button = document.createElement("button"), k = document.createElement("kbd");
    button.type = "submit"; button.className = "choice"; k.textContent = "Enter";
    button.append("This action", k);
    this.form.append(button);
  }

  // The middle of a box, 0 where it has none, and the first choice of everything else.
  middle() {
    const { kind, low, high } = this.action;
    return this.values.map((_, i) => kind !== "box" || low[i] === null || high[i] === null ? 0 : (low[i] + high[i]) / 2);
  }

  // What stands on the sliders, in the action's shape.
  shaped(flat = this.values) {
    const nest = (shape, take) => shape.length ? Array.from({ length: shape[0] }, () => nest(shape.slice(1), take)) : take();
    let i = 0;
    return nest(this.action.shape, () => flat[i++]);
  }

  // Which buttons can be pressed, and which one is marked.
  enable(on, allowed = null, marked = null) {
    for (const button of this.form.querySelectorAll(".choice")) {
      const choice = Number(button.dataset.choice);
      button.disabled = !on || Boolean(this.discrete && allowed && !allowed[choice]);
      if (this.discrete) button.setAttribute("aria-pressed", String(on && marked === choice));
    }
    for (const input of this.form.querySelectorAll(".entry input, .entry select")) input.disabled = !on;
  }

  // Put these numbers on the sliders; without `keep` only to be seen.
  put(values, keep = true) {
    if (keep) this.values = values.map(Number);
    this.form.querySelectorAll(".entry").forEach((row, i) => {
      for (const input of row.querySelectorAll("input, select")) if (keep || input !== document.activeElement) input.value = Number(values[i].toPrecision(6));
    });
  }

  named(action) {
    return this.discrete ? this.name(action) : [action].flat(Infinity).map((x) => this.action.kind === "box" ? x.toFixed(2) : x).join(", ");
  }
}

// --- what is seen -----------------------------------------------------------------------------------------------

const digits = (n) => (n.whole ? String(n.value) : n.value.toFixed(3));
const inWords = (numbers) => numbers.map((n) => `${n.name} ${digits(n)}`).join(", ");

// An observation in words, for those who do not see its picture.
export const described = (title, numbers) => title + (numbers.length ? `: ${inWords(numbers)}` : "");

// Each number over the last moments, the present one at the right.
export function draw({ numbers, trail }) {
  const canvas = $("plot"), pen = canvas.getContext("2d"), style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(name).trim();
  const lines = Math.max(1, numbers.length), height = Math.max(56, Math.min(110, 420 / lines));
  const scale = devicePixelRatio || 1, width = canvas.clientWidth || 640;
  canvas.width = width * scale; canvas.height = height * lines * scale;
  pen.scale(scale, scale);
  pen.font = "13px system-ui, 'DejaVu Sans', sans-serif";
  numbers.forEach((n, row) => {
    const top = row * height + 22, bottom = (row + 1) * height - 8;
    const y = (value) => bottom - (Math.min(Math.max(value, n.low), n.high) - n.low) / (n.high - n.low) * (bottom - top);
    const x = (i) => 16 + i * (width - 40) / 8;
    pen.fillStyle = color("--quiet");
    pen.fillText(`${n.name}   ${digits(n)}`, 16, row * height + 15);
    pen.strokeStyle = color("--line");
    pen.lineWidth = 1;
    pen.strokeRect(10, top - 3, width - 20, bottom - top + 6);
    const line = [...trail.map((t) => t[row]), n.value], first = 9 - line.length;
    pen.strokeStyle = color("--trail"); pen.lineWidth = 2; pen.beginPath();
    line.forEach((value, i) => i ? pen.lineTo(x(first + i), y(value)) : pen.moveTo(x(first), y(value)));
    pen.stroke();
    pen.fillStyle = color("--accent");
    pen.beginPath(); pen.arc(x(8), y(n.value), 5, 0, 7); pen.fill();
  });
  canvas.setAttribute("aria-label", inWords(numbers));
}

// The numbers beside a picture.
export function table({ numbers, trail, picture }) {
  const body = $("numbers").tBodies[0];
  body.replaceChildren();
  $("numbers").hidden = !picture || !numbers.length;
  if ($("numbers").hidden) return;
  const NS = "http://www.w3.org/2000/svg";
  numbers.forEach((n, row) => {
    const line = body.insertRow(), head = document.createElement("th");
    head.scope = "row"; head.textContent = n.name;
    line.append(head);
    const cell = line.insertCell(); cell.className = "scale";
    const svg = document.createElementNS(NS, "svg");
    svg.setAttribute("viewBox", "0 0 200 16"); svg.setAttribute("preserveAspectRatio", "none"); svg.setAttribute("aria-hidden", "true");
    const x = (value) => 4 + 192 * (Math.min(Math.max(value, n.low), n.high) - n.low) / (n.high - n.low);
    const part = (kind, values) => { const e = document.createElementNS(NS, kind); for (const [k, v] of Object.entries(values)) e.setAttribute(k, v); svg.append(e); };
    part("rect", { x: 4, y: 7, width: 192, height: 2, fill: "var(--line)" });
    trail.forEach((t, i) => part("rect", { x: x(t[row]) - 1.5, y: 4, width: 3, height: 8, fill: "var(--trail)", opacity: (i + 1) / (trail.length + 1) }));
    part("rect", { x: x(n.value) - 2, y: 1, width: 4, height: 14, fill: "var(--accent)" });
    cell.append(svg);
    const value = line.insertCell(); value.className = "value"; value.textContent = digits(n);
  });
}
