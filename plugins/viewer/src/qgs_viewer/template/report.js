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

for (const slider of all(".compare input"))
  slider.oninput = () => slider.parentElement.style.setProperty("--at", slider.value + "%");

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

const dialog = document.getElementById("zoom"), large = dialog.querySelector("img");
const pictures = all("figure img").filter((img) => !img.closest(".open, .compare"));
let place = 0;
function zoom(img) {
  place = pictures.indexOf(img);
  large.src = img.src;
  large.alt = dialog.querySelector("p").textContent = img.alt;
  large.classList.toggle("pixels", img.naturalWidth <= 128);
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
