// A row of pictures in <div class="slider"> becomes one picture and a slider; without this script the row stays.
for (const row of document.querySelectorAll("div.slider")) {
  const pictures = [...row.querySelectorAll("img")];
  const range = document.createElement("input");
  range.type = "range";
  range.max = pictures.length - 1;
  range.value = Math.floor(pictures.length / 2);
  const label = document.createElement("label");
  const caption = document.createElement("output");
  label.append(row.dataset.label ?? "", range);
  const show = () => {
    const shown = pictures[range.value];
    pictures.forEach((picture) => { picture.hidden = picture !== shown; });
    range.setAttribute("aria-valuetext", shown.alt);
    caption.textContent = shown.alt;
  };
  range.addEventListener("input", show);
  row.classList.add("one");
  row.prepend(label, caption);
  show();
}
