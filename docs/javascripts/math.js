// Draws the equations of a page by KaTeX, from the marks that arithmatex leaves.
document.addEventListener("DOMContentLoaded", () => {
  for (const each of document.querySelectorAll(".arithmatex")) {
    const displayed = each.tagName === "DIV";
    const text = each.textContent.trim().replace(/^\\[([]/, "").replace(/\\[)\]]$/, "");
    katex.render(text, each, { displayMode: displayed, throwOnError: true });
  }
});
