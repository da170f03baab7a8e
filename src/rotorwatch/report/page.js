// The report page's own script: theme of the plots, rotor switches, touch, saving the JSON, copying the post. Plots are Bokeh's.
(function () {
  "use strict";
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const touch = matchMedia("(pointer: coarse)").matches;

  function figures() {
    return Bokeh.documents.flatMap((doc) => doc.roots());
  }

  function paint(isDark) {
    const ink = isDark ? "#b7c0c9" : "#4a535c";
    for (const f of figures()) {
      for (const axis of [...f.below, ...f.left]) {
        for (const what of ["axis_label_text_color", "major_label_text_color", "axis_line_color", "major_tick_line_color"]) {
          axis[what] = ink;
        }
      }
      for (const thing of f.center) {
        if (thing.type === "Legend") thing.label_text_color = ink;
        if (thing.type === "Label") thing.text_color = ink;
      }
    }
  }

  function start() {
    paint(dark.matches);
    dark.addEventListener("change", (event) => paint(event.matches));
    addEventListener("beforeprint", () => paint(false));
    addEventListener("afterprint", () => paint(dark.matches));
    // A finger that scrolls the page must not zoom a plot by accident.
    if (touch) for (const f of figures()) f.toolbar.gestures.pan.active = null;
    for (const chip of document.querySelectorAll(".chips button")) {
      chip.addEventListener("click", () => {
        const on = chip.getAttribute("aria-pressed") !== "true";
        chip.setAttribute("aria-pressed", String(on));
        for (const f of figures()) {
          for (const line of f.renderers) if (line.name === chip.dataset.rotor) line.visible = on;
        }
      });
    }
    document.documentElement.dataset.plots = String(figures().length);
  }

  const save = document.getElementById("save-json");
  if (save) {
    save.addEventListener("click", () => {
      const text = document.getElementById("diagnosis").textContent;
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([text], { type: "application/json" }));
      link.download = save.dataset.name;
      link.click();
    });
  }

  const copy = document.getElementById("copy-markdown");
  if (copy) {
    const box = document.getElementById("post");
    const status = document.getElementById("copied");
    // Elsewhere than on a page that is safe against eavesdropping, browsers copy only what is selected.
    const selected = () => {
      box.hidden = false;
      box.select();
      let done = false;
      try {
        done = document.execCommand("copy");
      } catch {
        done = false;
      }
      box.hidden = done;
      if (done) copy.focus();
      return done;
    };
    copy.addEventListener("click", async () => {
      box.value = JSON.parse(document.getElementById("markdown").textContent);
      status.textContent = "";
      let done = false;
      try {
        await navigator.clipboard.writeText(box.value);
        done = true;
      } catch {
        done = selected();
      }
      if (done) box.hidden = true;
      status.textContent = done
        ? "Copied. It names no position and no serial number."
        : "The browser does not let this page copy: the text is selected below, copy it with Ctrl+C.";
    });
  }

  const wanted = document.querySelectorAll(".plot").length;
  if (!wanted) return;
  (function wait() {
    if (window.Bokeh && figures().length >= wanted && Object.keys(Bokeh.index).length !== 0) start();
    else setTimeout(wait, 30);
  })();
})();
