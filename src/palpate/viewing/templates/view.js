"use strict";
const by = id => document.getElementById(id);
const token = new URLSearchParams(location.search).get("token") || "";
const url = (path, values) => path + "?" + new URLSearchParams({...values, token});
let data, photo = null, place = [0.5, 0.5], asked = 0;

function show() {
  const chosen = data.recordings.find(r => r.name === by("recording").value);
  by("suspicious").replaceChildren(...(chosen ? chosen.suspicious : []).map(text => {
    const item = document.createElement("li");
    item.textContent = text;
    return item;
  }));
  by("samples").replaceChildren(...(chosen ? chosen.samples : []).map(sample => {
    const figure = document.createElement("figure");
    if (["train", "val", "test"].includes(sample.part)) figure.className = sample.part;
    for (const kind of sample.kinds) {
      const image = new Image();
      image.loading = "lazy";
      image.alt = `${kind} of ${sample.id}`;
      image.src = url("image", {k: sample.k, kind});
      figure.append(image);
    }
    const caption = document.createElement("figcaption");
    caption.textContent = [sample.id, sample.part, sample.material].filter(Boolean).join(" · ");
    figure.append(caption);
    return figure;
  }));
}

function list() {
  const shown = data.recordings.filter(r => !by("odd").checked || r.suspicious.length);
  by("recording").replaceChildren(...shown.map(r => {
    const mark = r.suspicious.length ? " (suspicious)" : "";
    return new Option(`${r.name}: ${r.samples.length}${mark}`, r.name);
  }));
  show();
}

async function touch() {
  if (!photo) return;
  const mine = ++asked, values = {};
  if (by("gel").value) values.gel = by("gel").value;
  if (data.contacts) {
    for (const field of by("contacts").querySelectorAll("input")) values[field.name] = field.value;
    [values.x, values.y] = place;
  }
  by("said").textContent = "touching ...";
  const answer = await fetch(url("touch", values), {method: "POST", body: photo});
  if (mine !== asked) return;
  if (!answer.ok) {
    by("said").textContent = (await answer.json()).error;
    return;
  }
  by("touch").src = URL.createObjectURL(await answer.blob());
  by("touch").hidden = false;
  by("place").hidden = !data.contacts;
  by("said").textContent = "";
}

function take(files) {
  if (files.length) photo = files[0];
  touch();
}

function move(event) {
  if (!data.contacts || !event.buttons) return;
  event.preventDefault();
  by("gelboard").setPointerCapture(event.pointerId);
  const box = by("gelboard").getBoundingClientRect();
  const share = (value, size) => Math.min(1, Math.max(0, value / size));
  place = [share(event.clientX - box.left, box.width), share(event.clientY - box.top, box.height)];
  by("place").style.left = 100 * place[0] + "%";
  by("place").style.top = 100 * place[1] + "%";
}

async function start() {
  data = await (await fetch(url("data.json", {}))).json();
  by("title").textContent = data.title;
  const count = data.recordings.reduce((sum, r) => sum + r.samples.length, 0);
  by("legend").textContent = `${count} samples of ${data.recordings.length} recordings. ` +
    "Edge: blue train, brown val, orange test.";
  by("touching").hidden = !data.touch;
  by("contacts").hidden = !data.contacts;
  for (const r of data.recordings) {
    const gel = r.samples.find(sample => sample.kinds.includes("background"));
    if (gel) by("gel").append(new Option(`of ${r.name}`, gel.k));
  }
  by("place").style.left = by("place").style.top = "50%";
  by("recording").onchange = show;
  by("odd").onchange = list;
  by("photo").onchange = () => take(by("photo").files);
  by("controls").onchange = touch;
  by("controls").onsubmit = () => false;
  by("drop").ondragover = event => { event.preventDefault(); by("drop").classList.add("over"); };
  by("drop").ondragleave = () => by("drop").classList.remove("over");
  by("drop").ondrop = event => {
    event.preventDefault();
    by("drop").classList.remove("over");
    take(event.dataTransfer.files);
  };
  by("gelboard").onpointerdown = by("gelboard").onpointermove = move;
  by("gelboard").onpointerup = touch;
  list();
}

start();
