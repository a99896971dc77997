// Draw the formulas of a page with KaTeX. Sphinx writes them as \( ... \) and \[ ... \].
document.addEventListener("DOMContentLoaded", () => {
  for (const element of document.querySelectorAll(".math")) {
    const match = element.textContent.trim().match(/^\\([(\[])([\s\S]*)\\[)\]]$/);
    if (match) katex.render(match[2], element, { displayMode: match[1] === "[", throwOnError: false });
  }
});
