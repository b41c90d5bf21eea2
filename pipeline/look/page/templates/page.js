"use strict";
(() => {
  const root = document.documentElement;

  // Light or dark as the system has it, or as chosen here: kept for this file where it may be.
  const button = document.getElementById("theme");
  const system = matchMedia("(prefers-color-scheme: dark)");
  const key = "theme:" + location.pathname;
  const stored = (work) => { try { return work(localStorage); } catch { return null; } };
  const dark = () => (root.dataset.theme ?? (system.matches ? "dark" : "light")) === "dark";
  const label = () => { button.textContent = dark() ? "Light" : "Dark"; };
  const chosen = stored((storage) => storage.getItem(key));
  if (chosen === "light" || chosen === "dark") root.dataset.theme = chosen;
  button.hidden = false;
  button.addEventListener("click", () => {
    root.dataset.theme = dark() ? "light" : "dark";
    stored((storage) => storage.setItem(key, root.dataset.theme));
    label();
  });
  system.addEventListener("change", label);
  label();

  // On a phone the contents begin folded, and fold again once one is chosen.
  const nav = document.querySelector("nav");
  const contents = nav.querySelector("details");
  const narrow = matchMedia("(max-width: 60rem)");
  const fold = () => { contents.open = !narrow.matches; };
  narrow.addEventListener("change", fold);
  contents.addEventListener("click", (event) => {
    if (event.target.closest("a") && narrow.matches) contents.open = false;
  });
  fold();

  // A picture opens large; it moves there and back, so that its ids stay the only ones.
  const large = document.getElementById("large");
  const place = large.querySelector(".place");
  let home = null;
  const enlarge = (box) => {
    home = box;
    box.style.height = box.offsetHeight + "px";
    place.append(box.querySelector("svg"));
    large.showModal();
  };
  for (const box of document.querySelectorAll(".enlarge")) {
    box.setAttribute("role", "button");
    box.setAttribute("aria-label", "Enlarge: " + box.querySelector("title").textContent);
    box.addEventListener("click", () => enlarge(box));
    box.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      enlarge(box);
    });
  }
  place.addEventListener("click", (event) => { if (event.target === place) large.close(); });
  large.addEventListener("close", () => {
    home.append(place.firstElementChild);
    home.style.height = "";
    home.focus({ preventScroll: true });
  });

  // The contents show where the reader is.
  const links = new Map(
    [...document.querySelectorAll("nav a")].map((link) => [link.getAttribute("href").slice(1), link]),
  );
  const above = new Map();
  const mark = (entries) => {
    for (const { target, isIntersecting } of entries) above.set(target.id, isIntersecting);
    // The last of those in sight in the order of the page is the innermost.
    const here = [...links.keys()].filter((id) => above.get(id)).pop();
    for (const link of links.values()) link.removeAttribute("aria-current");
    const link = links.get(here);
    link?.setAttribute("aria-current", "true");
    // Long contents scroll along in their own box.
    if (link && !narrow.matches) nav.scrollTop = link.offsetTop - nav.clientHeight / 2;
  };
  // In sight is what crosses a line a fifth down the window.
  const observer = new IntersectionObserver(mark, { rootMargin: "-20% 0px -80% 0px" });
  for (const section of document.querySelectorAll("main section")) observer.observe(section);
})();
