"use strict";
(async () => {
  // plotly.js is packed to a third of its size.
  const packed = Uint8Array.from(atob(document.getElementById("plotly").textContent), (sign) => sign.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.textContent = await new Response(stream).text();
  document.head.append(script);

  const probe = document.createElement("i");
  const colour = (name) => {
    probe.style.color = `var(--${name})`;
    document.body.append(probe);
    const found = getComputedStyle(probe).color;
    probe.remove();
    return found;
  };
  const draw = (box, text) => {
    const ink = colour("ink"), grid = colour("grid"), paper = colour("paper");
    const chart = JSON.parse(text.replace(/"@(ink|grid|blue)"/g, (_, name) => `"${colour(name)}"`));
    const layout = chart.layout;
    // Kept over a change of colours: where the reader has zoomed to.
    Object.assign(layout, { paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)", uirevision: "kept", autosize: true });
    layout.font = { ...layout.font, family: getComputedStyle(document.body).fontFamily, color: ink };
    layout.hoverlabel = { bgcolor: paper, bordercolor: grid, ...layout.hoverlabel, font: { color: ink } };
    layout.modebar = { bgcolor: "rgba(0,0,0,0)", color: colour("soft"), activecolor: ink };
    for (const name of ["xaxis", "yaxis"]) layout[name] ??= {};
    for (const [name, axis] of Object.entries(layout)) {
      if (/^[xy]axis\d*$/.test(name)) Object.assign(axis, { gridcolor: grid, zerolinecolor: grid, linecolor: ink, tickcolor: ink });
    }
    // A finger scrolls the page; the chart is zoomed by its buttons there.
    if (matchMedia("(pointer: coarse)").matches) layout.dragmode = false;
    delete layout.width;
    if (box.clientWidth < 600) {
      layout.margin = { l: 8, r: 8, t: 44, b: 8 };
      layout.legend = { ...layout.legend, orientation: "h", x: 0, xanchor: "left", y: -0.2, yanchor: "top" };
      for (const [name, axis] of Object.entries(layout)) {
        if (/^[xy]axis\d*$/.test(name)) axis.automargin = true;
      }
    }
    Plotly.react(box, chart.data, layout, {
      displaylogo: false,
      responsive: true,
      modeBarButtons: [["zoom2d", "pan2d"], ["zoomIn2d", "zoomOut2d", "resetScale2d"], ["toImage"]],
    });
  };
  for (const box of document.querySelectorAll(".chart")) {
    const script = box.querySelector("script");
    const text = script.textContent;
    script.remove();
    draw(box, text);
    document.addEventListener("theme", () => draw(box, text));
  }
})();
