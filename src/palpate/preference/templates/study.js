"use strict";
(() => {
const KEYS = "1234567890abcdefghijklmnopqrstvwxyz"; // without u, which takes the last vote back
const NAMES = { left: "Left", right: "Right", same: "Same" };
const LATER = [0, 408, 429]; // statuses, next to 5xx, after which the same vote is sent again
const SECONDS = 5; // that a trial takes
const PAUSES = [1, 2, 4, 8, 15]; // seconds before a vote is sent again
const $ = id => document.getElementById(id);
const served = document.body.dataset.served !== undefined;
const token = new URLSearchParams(location.search).get("token");
let study, rater, trials; // trials: those of the rater, in their order
let shown = null; // the trial on the screen, once its images are; no vote counts before
const refusals = new Set(); // trials whose votes the server refused since this page was loaded
let turn = 0, sending = false, failures = 0, timer = 0, ended = false, keeps = true;

// Votes are kept one an entry, palpate/STUDY/RATER/TRIAL, so that no tab overwrites what another
// wrote. An undone vote stands until the trial, whose name is the entry "again", has a new one.
const memory = new Map(); // for a browser that keeps nothing
const key = name => `palpate/${study.study}/${rater}/${name}`;
function read(name) {
  try {
    return JSON.parse(memory.get(key(name)) ?? localStorage.getItem(key(name)));
  } catch {
    return null;
  }
}
function write(name, value) {
  const text = JSON.stringify(value);
  try {
    localStorage.setItem(key(name), text);
    memory.delete(key(name));
  } catch {
    memory.set(key(name), text);
    keeps = false;
  }
  try {
    journal?.transaction("votes", "readwrite").objectStore("votes").put(text, key(name));
  } catch { // the browser closed it
    journal = null;
  }
}
// localStorage reaches the disk seconds later, IndexedDB at once: a browser that is killed loses no
// vote. Only what localStorage lacks is taken from there.
let journal = null;
async function restore() {
  const done = request => new Promise((good, bad) => {
    request.onsuccess = () => good(request.result);
    request.onerror = bad;
  });
  const request = indexedDB.open("palpate", 1);
  request.onupgradeneeded = () => request.result.createObjectStore("votes");
  journal = await done(request);
  const votes = journal.transaction("votes").objectStore("votes");
  const range = IDBKeyRange.bound(`palpate/${study.study}/`, `palpate/${study.study}/~`);
  const [names, texts] = await Promise.all([done(votes.getAllKeys(range)), done(votes.getAll(range))]);
  names.forEach((name, k) => {
    const here = JSON.parse(localStorage.getItem(name)), there = JSON.parse(texts[k]);
    if (name.endsWith("/again") || (here?.undone ?? -1) < there.undone) localStorage.setItem(name, texts[k]);
  });
}
const voted = () => trials.filter(trial => read(trial.trial));
const unsent = () => voted().filter(trial => !read(trial.trial).sent);
const refused = () => unsent().some(({ trial }) => refusals.has(trial));
const waiting = () =>
  trials.find(trial => trial.trial === read("again")) ?? trials.find(trial => !read(trial.trial));
// Served, the clock of the server counts, not that of the rater.
const closed = () => ended || (!served && study.until && new Date().toISOString().slice(0, 10) > study.until);

function vote(choice) {
  if (!shown) return;
  const { trial, before, since } = shown;
  if ((read(trial)?.undone ?? -1) !== before) return show("Answered in another tab: here is the next.");
  const ms = Math.round(performance.now() - since);
  write(trial, { choice, ms, at: new Date().toISOString(), undone: before + 1 });
  write("again", null);
  refusals.delete(trial);
  show();
  send();
}
function undo() {
  const last = voted().at(-1);
  if (!last || read("again") || closed()) return;
  write("again", last.trial);
  show("Vote again; until then the last vote stands.");
}

async function show(message = "") {
  const trial = closed() ? undefined : waiting(), mine = ++turn;
  shown = null;
  for (const name of ["start", "trial", "end"]) $(name).hidden = name !== (trial ? "trial" : "end");
  $("footer").hidden = false;
  $("message").textContent = message;
  $("rater-name").textContent = `Rater ${rater}`;
  refresh(trial);
  if (!trial) return finish();
  document.body.classList.toggle("alone", study.task === "pair" && !trial.reference);
  const images = study.task === "pair"
    ? [["reference", trial.reference], ["left", trial.left], ["right", trial.right]]
    : [["reference", trial.image]];
  const ready = images.map(([place, name]) => place_image(place, name));
  await Promise.all(ready.map(image => image?.decode().catch(() => {})));
  if (mine !== turn) return; // another trial came meanwhile
  $("trial").dataset.trial = trial.trial;
  shown = { trial: trial.trial, before: read(trial.trial)?.undone ?? -1, since: performance.now() };
}
function place_image(place, name) {
  const image = document.querySelector(`[data-place="${place}"]`);
  if (place === "reference") $("reference").hidden = !name;
  if (!name) return null;
  const { src, w, h } = study.images[name];
  Object.assign(image, { width: w, height: h, src });
  return image;
}
function refresh(trial) {
  const done = voted().length, left = served ? unsent().length : 0;
  const place = trial ? trials.indexOf(trial) + 1 : done;
  $("progress").max = trials.length;
  $("progress").value = done;
  $("progress-name").textContent = trial ? `Trial ${place} of ${trials.length}` : `${done} of ${trials.length} votes`;
  $("undo").disabled = !done || Boolean(read("again")) || closed();
  $("download").disabled = !done;
  $("kept").textContent = refused()
    ? `The server refused ${votes(left)}: download your votes.`
    : left
    ? `${votes(left)} not yet at the server; this page keeps and sends ${left === 1 ? "it" : "them"}.`
    : served ? "All votes are at the server."
    : keeps ? `${votes(done)} kept in this browser.`
    : "This browser keeps nothing: download your votes before you close the page.";
}
const votes = count => `${count} vote${count === 1 ? "" : "s"}`;

function finish() {
  const missing = trials.length - voted().length;
  $("thanks").textContent = missing ? `This study ended on ${study.until ?? "the server"}.` : "Done. Thank you.";
  $("next-step").textContent = !served || refused() || unsent().length && closed()
    ? "Download your votes and send the file to the person who gave you this page."
    : unsent().length ? "Leave this page open until all votes are at the server."
    : "You may close this page.";
  $("another").hidden = served;
  $("download").classList.toggle("main", !served);
  $("thanks").focus();
}

// Server: every vote is sent until it is acknowledged; the same vote twice counts once.
async function ask(path, body) {
  const headers = { Authorization: `Bearer ${token}` };
  const options = body ? { method: "POST", body: JSON.stringify(body), keepalive: true } : {};
  return fetch(path, { ...options, headers, cache: "no-store", signal: AbortSignal.timeout(20000) });
}
async function send() {
  if (!served || sending) return;
  sending = true;
  let next;
  while ((next = unsent().find(({ trial }) => !refusals.has(trial))) && !ended) {
    const { choice, ms, at, undone } = read(next.trial);
    const body = { study: study.study, rater, trial: next.trial, choice, ms, at, undone };
    // A page of something between here and the server is no acknowledgment.
    const status = await ask("vote", body)
      .then(async answer => (!answer.ok || (await answer.json()).stored ? answer.status : 0))
      .catch(() => 0);
    if (status === 410) ended = true;
    else if (LATER.includes(status) || status >= 500) break;
    else if (read(next.trial).undone !== undone) continue; // voted again meanwhile
    else if (status === 200) write(next.trial, { choice, ms, at, undone, sent: true });
    else refusals.add(next.trial);
    failures = 0;
    refresh(waiting());
  }
  sending = false;
  if (ended || (!waiting() && !$("end").hidden)) show();
  else refresh(waiting());
  clearTimeout(timer);
  if (next && !ended) timer = setTimeout(send, 1000 * PAUSES[Math.min(failures++, PAUSES.length - 1)]);
}
async function fetched() {
  for (let k = 0; ; k++) {
    const answer = await ask("study.json").catch(() => null);
    if (answer?.ok) return answer.json();
    if (answer && answer.status < 500 && answer.status !== 429) throw new Error(`status ${answer.status}`);
    $("rater-name").textContent = "The server does not answer; trying again.";
    await new Promise(done => setTimeout(done, 1000 * PAUSES[Math.min(k, PAUSES.length - 1)]));
  }
}
async function merge() { // what another device of this rater sent
  const answer = await ask("votes").catch(() => null);
  if (!answer?.ok) return;
  for (const { trial, ...vote } of (await answer.json()).votes)
    if ((read(trial)?.undone ?? -1) <= vote.undone) write(trial, { ...vote, sent: true });
}

// Download: JSON whose digest is the SHA-256 of all else, keys sorted, without spaces.
const canonical = value =>
  Array.isArray(value) ? `[${value.map(canonical)}]`
  : value && typeof value === "object"
    ? `{${Object.keys(value).sort().map(name => `${JSON.stringify(name)}:${canonical(value[name])}`)}}`
  : JSON.stringify(value);
function sha256(text) { // crypto.subtle is absent on pages that come over plain HTTP
  const primes = [];
  for (let n = 2; primes.length < 64; n++) if (primes.every(p => n % p)) primes.push(n);
  const bits = root => primes.map(p => ((root(p) % 1) * 2 ** 32) | 0);
  const K = bits(Math.cbrt), H = bits(Math.sqrt).slice(0, 8);
  const data = new TextEncoder().encode(text), size = ((data.length + 72) >> 6) << 6;
  const bytes = new Uint8Array(size), view = new DataView(bytes.buffer);
  bytes.set(data);
  bytes[data.length] = 0x80;
  view.setUint32(size - 8, Math.floor(data.length / 2 ** 29));
  view.setUint32(size - 4, data.length << 3);
  const turned = (x, n) => (x >>> n) | (x << (32 - n));
  for (let at = 0; at < size; at += 64) {
    const w = Array.from({ length: 16 }, (_, k) => view.getInt32(at + 4 * k));
    for (let k = 16; k < 64; k++) {
      const a = w[k - 15], b = w[k - 2];
      const s = turned(a, 7) ^ turned(a, 18) ^ (a >>> 3), t = turned(b, 17) ^ turned(b, 19) ^ (b >>> 10);
      w[k] = (w[k - 16] + s + w[k - 7] + t) | 0;
    }
    let [a, b, c, d, e, f, g, h] = H;
    for (let k = 0; k < 64; k++) {
      const s = turned(e, 6) ^ turned(e, 11) ^ turned(e, 25);
      const one = (h + s + ((e & f) ^ (~e & g)) + K[k] + w[k]) | 0;
      const t = turned(a, 2) ^ turned(a, 13) ^ turned(a, 22);
      const two = (t + ((a & b) ^ (a & c) ^ (b & c))) | 0;
      [h, g, f, e, d, c, b, a] = [g, f, e, (d + one) | 0, c, b, a, (one + two) | 0];
    }
    [a, b, c, d, e, f, g, h].forEach((x, k) => { H[k] = (H[k] + x) | 0; });
  }
  return H.map(x => (x >>> 0).toString(16).padStart(8, "0")).join("");
}
function download() {
  const rows = voted().map(({ trial }) => {
    const { choice, ms, at, undone } = read(trial);
    return { trial, choice, ms, at, undone };
  });
  const viewport = [innerWidth, innerHeight].map(Math.round);
  const file = { format: "palpate/preference-votes@1", study: study.study, rater, viewport, votes: rows };
  const text = JSON.stringify({ ...file, digest: sha256(canonical(file)) }, null, 1);
  const url = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  const link = document.createElement("a");
  Object.assign(link, { href: url, download: `votes-${study.study}-${rater}.json` });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 60000);
}

// Buttons of the choices; text is only ever set as text, so that no name becomes markup.
function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}
function button(choice, k) {
  const strip = study.strips?.find(({ answer }) => answer === choice);
  const hint = element("kbd", { textContent: KEYS[k] ?? "" });
  hint.setAttribute("aria-hidden", "true");
  const name = element("span", { className: "name" }, strip?.label ?? NAMES[choice] ?? choice, hint);
  const made = element("button", { type: "button" });
  made.dataset.choice = choice;
  if (KEYS[k]) made.setAttribute("aria-keyshortcuts", KEYS[k]);
  else hint.remove();
  if (strip) {
    const example = image => element("img", { alt: "", width: study.images[image].w, height: study.images[image].h, src: study.images[image].src });
    made.append(name, element("span", { className: "examples" }, ...strip.images.map(example)));
  } else if (choice !== "same") {
    const image = element("img", { alt: "" });
    image.dataset.place = choice;
    made.append(image, name);
  } else made.append(name);
  // The second click of a double click is not meant for the trial that the first one brought.
  made.addEventListener("click", event => event.detail < 2 && vote(choice));
  return made;
}
function build() {
  document.body.classList.add(study.task);
  for (const place of document.querySelectorAll(".question")) place.textContent = study.question;
  const image = $("reference").querySelector("img");
  image.dataset.place = "reference";
  image.alt = study.task === "pair" ? "Reference image" : "Image to sort";
  $("reference").querySelector("figcaption").textContent = study.task === "pair" ? "Reference" : "Which is it?";
  $("choices").append(...study.choices.map(button));
  const ways = study.task === "pair" ? "1 for left, 2 for right, 3 for same" : "the key shown with each answer";
  const count = Object.values(study.raters)[0].length; // every rater has as many
  const times = count === 1 ? "once" : `${count} times`, minutes = Math.max(1, Math.round(count * SECONDS / 60));
  const task = study.task === "pair"
    ? [`You will see, ${times}, a picture of a surface taken by a touch sensor (Reference, in the middle; on a phone on top) and two others.`,
      "Choose the one whose surface is closer to the Reference, as the question above asks, or Same if you cannot tell."]
    : [`You will see, ${times}, a picture of a surface as a touch sensor takes it, and examples of every answer.`,
      "Choose the answer whose examples are closest to the picture; if you cannot tell, choose the likeliest."];
  $("how").textContent = [
    ...task,
    `${count} trial${count === 1 ? "" : "s"} take about ${minutes} minute${minutes === 1 ? "" : "s"}; there is no time limit.`,
    `Answer by mouse, by touch or by key: ${ways}; u undoes the last vote.`,
    "Votes are kept after every answer: you may close the page and go on later.",
    "Recorded under your code are your answers, when and how fast you gave them, undone votes and, in a file that you download, the size of the window; nothing else.",
  ].join("\n");
}

function start() {
  ++turn;
  shown = null;
  const codes = Object.keys(study.raters);
  const linked = location.hash.slice(1);
  for (const name of ["trial", "end"]) $(name).hidden = true;
  $("footer").hidden = true;
  $("rater-name").textContent = "";
  $("start").hidden = false;
  $("code").hidden = codes.length < 2;
  $("rater").replaceChildren(
    ...(codes.length > 1 ? [element("option", { value: "", textContent: "Choose" })] : []),
    ...codes.map(code => element("option", { value: code, textContent: code })),
  );
  if (codes.includes(linked) || codes.length === 1) choose(codes.includes(linked) ? linked : codes[0]);
  label();
}
function choose(code) {
  [rater, trials] = [code, study.raters[code]];
  $("rater").value = code;
}
function label() { // says how far a rater is who comes back
  const done = $("rater").value ? voted().length : 0;
  $("begin").querySelector("button").textContent = done ? `Continue, ${done} of ${trials.length} done` : "Start";
}
function listen() {
  $("rater").addEventListener("change", event => {
    if (event.target.value) choose(event.target.value);
    label();
  });
  $("begin").addEventListener("submit", event => {
    event.preventDefault();
    history.replaceState(null, "", `#${rater}`);
    show();
    send();
  });
  $("undo").addEventListener("click", undo);
  $("download").addEventListener("click", download);
  $("another").addEventListener("click", () => {
    history.replaceState(null, "", location.pathname + location.search);
    start();
  });
  document.addEventListener("keydown", event => {
    if (event.ctrlKey || event.metaKey || event.altKey || $("footer").hidden) return;
    const place = KEYS.indexOf(event.key.toLowerCase()), single = event.key.length === 1;
    if (event.repeat) { // a key held down is one answer
      if (event.key === "Enter") event.preventDefault();
    } else if (event.key.toLowerCase() === "u") undo();
    else if (single && place >= 0 && place < study.choices.length) vote(study.choices[place]);
  });
  // Another tab voted, or this page comes back from sleep: show what is to be answered now.
  const changed = () => {
    if (!rater || !$("start").hidden) return;
    const next = closed() ? undefined : waiting();
    if (next?.trial !== shown?.trial || (shown && (read(shown.trial)?.undone ?? -1) !== shown.before)) show();
    else refresh(next);
  };
  addEventListener("storage", event => (event.key ?? "palpate/").startsWith("palpate/") && changed());
  addEventListener("focus", changed);
  addEventListener("online", send);
}
async function main() {
  try {
    study = JSON.parse($("study").textContent) ?? (await fetched());
    ended = Boolean(study.ended);
  } catch {
    $("rater-name").textContent = "This invitation is not valid, or the page is damaged: ask for a new one.";
    return;
  }
  // Not every browser has it in every mode.
  await Promise.race([restore(), new Promise(done => setTimeout(done, 2000))]).catch(() => {});
  build();
  start();
  listen();
  if (rater && served) await merge();
  label();
  // A reload goes on at the same trial.
  if (rater && location.hash.slice(1) === rater && voted().length) show();
  send();
  navigator.storage?.persist?.().catch(() => {});
}
main();
})();
