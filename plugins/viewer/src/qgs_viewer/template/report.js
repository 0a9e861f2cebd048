// Zoom, sliders, embedded pages and the colour scheme of report.html; without it all is shown still.
const all = (what) => [...document.querySelectorAll(what)];
const root = document.documentElement;
root.classList.add("js");

const system = matchMedia("(prefers-color-scheme: dark)"), theme = document.getElementById("theme");
const isDark = () => (root.style.colorScheme ? root.style.colorScheme === "dark" : system.matches);
const name = () => (theme.textContent = isDark() ? "Light" : "Dark");
theme.onclick = () => { root.style.colorScheme = isDark() ? "light" : "dark"; name(); };
system.onchange = name;
name();

const sliders = all(".compare input");
function slide(value) {
  for (const slider of sliders) {
    slider.value = value;
    slider.parentElement.style.setProperty("--at", slider.value + "%");
  }
}
for (const slider of sliders) {
  slider.oninput = () => slide(slider.value);
  // Phones move a slider by its thumb alone, here by any place.
  slider.onpointerdown = slider.onpointermove = (event) => {
    const { left, width } = slider.getBoundingClientRect();
    if (event.buttons) slide((100 * (event.clientX - left)) / width);
  };
}

const large = all(".large .compare"), picks = all(".picks button"), picked = { view: "0", model: "0" };
for (const button of picks)
  button.onclick = () => {
    picked[button.dataset.pick] = button.dataset.number;
    for (const pick of picks) pick.ariaPressed = pick.dataset.number === picked[pick.dataset.pick];
    for (const figure of large)
      figure.hidden = figure.dataset.view !== picked.view || figure.dataset.model !== picked.model;
  };
for (const pick of picks.filter((pick) => pick.dataset.pick === "view")) {
  const small = document.createElement("img");
  small.src = large.find((figure) => figure.dataset.view === pick.dataset.number).querySelector("img").src;
  small.alt = pick.title;
  pick.replaceChildren(small);
}

for (const button of all(".open"))
  button.onclick = () => {
    const frame = document.createElement("iframe");
    frame.sandbox = "allow-scripts";
    frame.title = button.querySelector("img").alt;
    frame.srcdoc = button.dataset.page;
    button.after(frame);
    button.classList.add("opened");
    frame.focus();
  };

const dialog = document.getElementById("zoom"), enlarged = dialog.querySelector("img");
const pictures = all("figure img").filter((img) => !img.closest(".open, .compare"));
let place = 0;
function zoom(img) {
  place = pictures.indexOf(img);
  enlarged.src = img.src;
  enlarged.alt = dialog.querySelector("p").textContent = img.alt;
  enlarged.classList.toggle("pixels", img.naturalWidth <= 128);
  if (!dialog.open) dialog.showModal();
}
for (const img of pictures) {
  img.tabIndex = 0;
  img.role = "button";
  img.onclick = () => zoom(img);
  img.onkeydown = (event) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    zoom(img);
  };
}
dialog.onclick = () => dialog.close();
dialog.onclose = () => pictures[place].focus();
dialog.onkeydown = (event) => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  const seen = pictures.filter((img) => img.checkVisibility());
  zoom(seen[(seen.indexOf(pictures[place]) + step + seen.length) % seen.length]);
};
