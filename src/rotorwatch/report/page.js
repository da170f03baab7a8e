// The report page's own script: theme of the plots, rotor switches, touch, the moment in the address, saving the JSON, copying. Plots are Bokeh's.
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
      for (const drawn of f.renderers) if (drawn.name === "mode names") drawn.glyph.text_color = isDark ? "#e8ebee" : "#1b2127";
      for (const thing of f.center) {
        if (thing.type === "Legend") thing.label_text_color = isDark ? "#e8ebee" : "#1b2127";
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
    moments();
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

  // A moment of the flight: marked in all plots and on the map, named by the page's address (#t=34.2).
  const form = document.getElementById("at");
  const field = document.getElementById("at-time");
  const track = document.getElementById("track");

  function moments() {
    if (!form) return; // only the picture of one moment
    const spans = new Set(figures().flatMap((f) => f.center.filter((thing) => thing.name === "moment")));
    const box = document.getElementById("at-set");
    const status = document.getElementById("at-status");
    const first = Number(field.min);
    const last = Number(field.max);

    /** Mark a moment, or none (null). */
    const mark = (time) => {
      if (time === null) field.value = "";
      for (const span of spans) {
        if (time !== null) span.location = time;
        span.visible = time !== null;
      }
      if (track) place(time);
      status.textContent = "";
      box.hidden = time === null;
      form.classList.toggle("set", time !== null);
    };
    const chosen = (time) => {
      const rounded = time === null ? null : Math.round(Math.min(Math.max(time, first), last) * 100) / 100;
      field.value = rounded ?? "";
      mark(rounded);
      address(rounded);
    };
    /** The moment that the address names, or null for anything else. */
    const named = () => {
      const found = /^#t=(\d{1,7}(?:\.\d{1,6})?)$/.exec(location.hash);
      const time = found ? Number(found[1]) : NaN;
      return time >= first && time <= last ? time : null;
    };
    const arrive = () => {
      const time = named();
      if (time === null) return;
      field.value = time;
      mark(time);
      for (const f of figures()) {
        const x = f.x_range;
        if (spansWhole(f) && (time < x.start || time > x.end)) x.setv({ start: first, end: last });
      }
      const fold = document.getElementById("context");
      if (fold) fold.open = true;
      const target = fold ?? document.getElementById("plot-loss");
      // The plots in the fold are laid out first.
      requestAnimationFrame(() => requestAnimationFrame(() => target.scrollIntoView()));
    };
    const spansWhole = (f) => f.x_range.bounds && f.x_range.bounds[0] <= first && f.x_range.bounds[1] >= last;

    for (const f of figures()) f.on_event("tap", (event) => Number.isFinite(event.x) && chosen(event.x));
    if (track) track.addEventListener("click", (event) => chosen(nearest(event)));
    field.addEventListener("input", () => {
      const time = field.valueAsNumber;
      if (time >= first && time <= last) {
        mark(time);
        address(time);
      }
    });
    field.addEventListener("change", () => chosen(Number.isFinite(field.valueAsNumber) ? field.valueAsNumber : null));
    form.addEventListener("submit", (event) => event.preventDefault());
    document.getElementById("at-clear").addEventListener("click", () => {
      chosen(null);
      field.focus();
    });
    document.getElementById("at-copy").addEventListener("click", async () => {
      const done = await copied(location.href, document.getElementById("at-copy"));
      status.textContent = done ? "Copied." : "The browser does not let this page copy: take the link from the address bar.";
    });
    addEventListener("hashchange", () => {
      if (!location.hash) mark(null); // back to where no moment was named
      arrive();
    });
    // The address of a link that is followed twice does not change.
    document.addEventListener("click", (event) => event.target.closest?.('a[href^="#t="]') && setTimeout(arrive));
    arrive();
  }

  /** The page's address names the moment; a browser that forbids that only loses the link. */
  function address(time) {
    const hash = time === null ? "" : `#t=${time}`;
    try {
      history.replaceState(null, "", hash || location.href.split("#")[0]);
    } catch {
      if (hash) location.replace(hash);
    }
  }

  /** [time, x, y] of every corner of the track. */
  function corners() {
    return [...track.querySelectorAll(".flown")].flatMap((line) => {
      const times = line.dataset.times.split(" ").map(Number);
      return times.map((time, k) => [time, line.points[k].x, line.points[k].y]);
    });
  }

  /** Put the map's circle where the vehicle was; it is not there at a time without a place. */
  function place(time) {
    const all = corners();
    const spot = track.querySelector(".moment");
    const after = time === null ? -1 : all.findIndex((c) => c[0] >= time);
    const there = after >= 0 && (after > 0 || all[0][0] === time);
    spot.setAttribute("visibility", there ? "visible" : "hidden");
    if (!there) return;
    const [t1, x1, y1] = all[after];
    const [t0, x0, y0] = all[Math.max(after - 1, 0)];
    const share = t1 > t0 ? (time - t0) / (t1 - t0) : 1;
    spot.setAttribute("cx", x0 + share * (x1 - x0));
    spot.setAttribute("cy", y0 + share * (y1 - y0));
  }

  /** When the vehicle was nearest to where the map was clicked. */
  function nearest(event) {
    const frame = track.getScreenCTM().inverse();
    const at = new DOMPoint(event.clientX, event.clientY).matrixTransform(frame);
    const all = corners();
    let best = [Infinity, all[0][0]];
    for (let k = 1; k < all.length; k++) {
      const [t0, x0, y0] = all[k - 1];
      const [t1, x1, y1] = all[k];
      const [dx, dy] = [x1 - x0, y1 - y0];
      const share = Math.min(1, Math.max(0, ((at.x - x0) * dx + (at.y - y0) * dy) / (dx * dx + dy * dy || 1)));
      const off = Math.hypot(x0 + share * dx - at.x, y0 + share * dy - at.y);
      if (off < best[0]) best = [off, t0 + share * (t1 - t0)];
    }
    return best[1];
  }

  /** Whether a text could be copied. Elsewhere than on a page that is safe against eavesdropping, browsers copy only what is selected. */
  async function copied(text, button) {
    const box = document.getElementById("post");
    box.value = text;
    try {
      await navigator.clipboard.writeText(text);
      box.hidden = true;
      return true;
    } catch {
      box.hidden = false;
      box.select();
      let done = false;
      try {
        done = document.execCommand("copy");
      } catch {
        done = false;
      }
      box.hidden = true;
      button.focus();
      return done;
    }
  }

  const copy = document.getElementById("copy-markdown");
  if (copy) {
    const box = document.getElementById("post");
    const status = document.getElementById("copied");
    copy.addEventListener("click", async () => {
      status.textContent = "";
      const done = await copied(JSON.parse(document.getElementById("markdown").textContent), copy);
      if (!done) {
        box.hidden = false;
        box.select();
      }
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
