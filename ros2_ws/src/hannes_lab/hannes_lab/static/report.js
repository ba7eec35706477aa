/* Curves that can be zoomed and read; everything else of the page works without this. */
(function () {
  "use strict";
  var root = document.documentElement;
  root.classList.add("js");
  var data = JSON.parse(document.getElementById("hannes-report-data").textContent);
  var shown = { measured: true, before: true, after: true, reference: true };
  var panels = [];

  function colour(name) {
    return getComputedStyle(root).getPropertyValue("--" + name).trim();
  }

  function minus(a, b) {
    return a.map(function (v, k) { return v == null || b[k] == null ? null : v - b[k]; });
  }

  /* Values of a curve at other times, by straight lines. */
  function at(times, values, wanted) {
    var k = 0;
    return wanted.map(function (t) {
      if (t == null || t < times[0] || t > times[times.length - 1]) return null;
      while (k > 0 && times[k] > t) k--;
      while (k < times.length - 2 && times[k + 1] < t) k++;
      var a = values[k], b = values[k + 1] === undefined ? a : values[k + 1], span = times[k + 1] - times[k];
      if (a == null || b == null) return null;
      return span > 0 ? a + (b - a) * (t - times[k]) / span : a;
    });
  }

  function phaseRuns(overlay) {
    var out = [], t = overlay.time, p = overlay.phase || [], first = 0;
    for (var k = 1; k <= p.length; k++) {
      if (k === p.length || p[k] !== p[first]) {
        out.push([p[first], first ? (t[first - 1] + t[first]) / 2 : t[first], k < t.length ? (t[k - 1] + t[k]) / 2 : t[k - 1]]);
        first = k;
      }
    }
    return out;
  }

  var KNOWN = ["void", "grasp", "hold", "opening", "rest"];

  /* Shades the phases; writes their names above the upper plot. */
  function shade(runs, names) {
    return function (u) {
      var c = u.ctx, r = window.devicePixelRatio || 1;
      c.save();
      runs.forEach(function (run) {
        var a = Math.max(u.valToPos(run[1], "x", true), u.bbox.left);
        var b = Math.min(u.valToPos(run[2], "x", true), u.bbox.left + u.bbox.width);
        if (!(b > a)) return;
        c.fillStyle = colour(KNOWN.indexOf(run[0]) < 0 ? "rest" : run[0]);
        c.fillRect(a, u.bbox.top, b - a, u.bbox.height);
        if (names) {
          c.font = 11 * r + "px system-ui, sans-serif";
          c.fillStyle = colour("soft");
          c.textAlign = "center";
          if (c.measureText(run[0]).width < b - a) c.fillText(run[0], (a + b) / 2, u.bbox.top - 5 * r);
        }
      });
      c.restore();
    };
  }

  function digits(v, reference) {
    if (v == null) return "–";
    var places = Math.max(0, Math.min(7, 2 - Math.floor(Math.log10(reference || 1))));
    return v.toFixed(places).replace("-", "−");
  }

  /* A label of the vertical axis: as short as its margin is narrow. */
  function tick(x) {
    var short = +x.toPrecision(6), small = short !== 0 && Math.abs(short) < 1e-3;
    return (small ? short.toExponential() : String(short)).replace(/-/g, "−");
  }

  function axis(extra) {
    return Object.assign({
      stroke: colour("soft"), grid: { stroke: colour("grid"), width: 1 }, ticks: { show: false },
      font: "11px system-ui, sans-serif"
    }, extra);
  }

  function padded(u, low, high) {
    if (low == null || high == null) return [-1, 1];
    var pad = high > low ? 0.07 * (high - low) : 0.1 * Math.abs(high) || 1;
    return [low - pad, high + pad];
  }

  function Panel(figure) {
    var o = data.comparison.overlays[+figure.dataset.overlay];
    var later = figure.dataset.after === undefined ? null : data.after.overlays[+figure.dataset.after];
    var box = figure.querySelector(".plot"), readout = figure.querySelector(".readout");
    var after = later ? at(later.time, later.model, o.time) : null;
    var reference = o.signal === "encoder_position" ? o.reference : null;
    var spread = minus(o.high, o.measured);
    var size = Math.max.apply(null, o.measured.concat(o.model).map(function (v) { return Math.abs(v || 0); })) || 1;
    var off = minus(o.measured, o.model), offAfter = after && minus(o.measured, after);
    var small = Math.max.apply(null, off.concat(spread).map(function (v) { return Math.abs(v || 0); })) || size;
    var runs = phaseRuns(o), self = this, plots = [];
    this.group = figure.dataset.group.replace(/^\d+-/, "");
    this.zoomed = null;

    function lines(specs) {
      return [{}].concat(specs.map(function (s) {
        return { label: s[0], stroke: s[1] && colour(s[1]), width: s[1] ? (s[1] === "measured-line" ? 3.6 : 1.6) : 0, dash: s[2], points: { show: false },
                 show: s[3] === undefined ? true : shown[s[3]], spanGaps: false, key: s[3] };
      }));
    }

    function build() {
      plots.forEach(function (p) { p.destroy(); });
      var width = box.clientWidth || 480;
      var specs = [["high", null, null, "measured"], ["low", null, null, "measured"]], values = [o.time, o.high, o.low];
      if (reference) { specs.push(["reference", "reference", [2, 4], "reference"]); values.push(reference); }
      specs.push(["measured", "measured-line", null, "measured"], ["before", "before", null, "before"]);
      values.push(o.measured, o.model);
      if (after) { specs.push(["after", "after", null, "after"]); values.push(after); }
      var rspecs = [["high", null, null, "measured"], ["low", null, null, "measured"], ["before", "before", null, "before"]];
      var rvalues = [o.time, spread, minus(o.low, o.measured), off];
      if (after) { rspecs.push(["after", "after", null, "after"]); rvalues.push(offAfter); }
      function options(height, specs, top, names, xaxis) {
        return {
          width: width, height: height, legend: { show: false }, padding: [top, 8, 0, 0],
          cursor: { sync: { key: self.group, scales: ["x", null] }, points: { size: 6 }, drag: { x: true, y: false, setScale: false },
                    y: false, focus: { prox: -1 } },
          scales: { x: { time: false }, y: { range: padded } }, series: lines(specs),
          bands: [{ series: [1, 2], fill: colour("band") }],
          axes: [axis({ size: xaxis ? 28 : 0, show: xaxis, values: function (u, v) {
                   return v.map(function (x, k) { return String(+x.toFixed(6)) + (k === v.length - 1 ? " s" : ""); }); } }),
                 axis({ size: 52, space: xaxis ? 22 : 32, values: function (u, v) {
                   return v.map(tick); } })],
          hooks: {
            drawClear: [shade(runs, names)],
            setCursor: [function (u) { if (u === plots[0]) tell(u.cursor.idx); }],
            setSelect: [function (u) {
              if (u.select.width > 4) zoom(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
              u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
            }]
          }
        };
      }
      plots = [new uPlot(options(210, specs, 20, true, false), values, box),
               new uPlot(options(126, rspecs, 10, false, true), rvalues, box)];
      plots.forEach(function (p) { p.over.addEventListener("dblclick", function () { zoom(null); }); });
      if (self.zoomed) scale(self.zoomed[0], self.zoomed[1]);
      tell(null);
    }

    function tell(k) {
      var t = k == null ? null : o.time[k];
      readout.textContent = "";
      function add(name, text, strong) {
        var e = document.createElement(strong ? "b" : "span");
        e.className = name;
        e.textContent = text;
        readout.append(e, "  ");
      }
      if (t == null) { add("", "lower plot: measured − model, " + (o.unit || "") .replace(".", "·")); return; }
      add("", "t = " + t.toFixed(2) + " s", false);
      add("", "measured " + digits(o.measured[k], size) + (spread[k] > 0 ? " ± " + digits(spread[k], small) : ""), true);
      add("before", (after ? "before " : "model ") + digits(o.model[k], size) + " (residual " + digits(off[k], small) + ")");
      if (after) add("after", "after " + digits(after[k], size) + " (residual " + digits(offAfter[k], small) + ")");
    }

    function scale(a, b) { plots.forEach(function (p) { p.setScale("x", { min: a, max: b }); }); }

    var reset = document.createElement("button");
    reset.type = "button";
    reset.className = "quiet reset";
    reset.textContent = "Reset zoom";
    reset.hidden = true;
    reset.addEventListener("click", function () { zoom(null); });
    box.append(reset);

    this.setZoom = function (range) {
      self.zoomed = range;
      reset.hidden = !range;
      scale(range ? range[0] : o.time[0], range ? range[1] : o.time[o.time.length - 1]);
    };

    /* All signals of one condition show the same stretch. */
    function zoom(a, b) {
      panels.forEach(function (p) { if (p.group === self.group) p.setZoom(a == null ? null : [a, b]); });
    }

    box.addEventListener("keydown", function (event) {
      var u = plots[0], k = u.cursor.idx == null ? 0 : u.cursor.idx, s = u.scales.x, middle;
      if (event.target !== box || event.ctrlKey || event.metaKey || event.altKey) return;
      if (event.key === "ArrowRight" || event.key === "ArrowLeft") {
        k = Math.min(o.time.length - 1, Math.max(0, k + (event.key === "ArrowRight" ? 1 : -1) * (event.shiftKey ? 10 : 1)));
        u.setCursor({ left: u.valToPos(o.time[k], "x"), top: 10 });
        tell(k);
      } else if (event.key === "+" || event.key === "=" || event.key === "-") {
        middle = u.cursor.idx == null ? (s.min + s.max) / 2 : o.time[k];
        var f = event.key === "-" ? 2 : 0.5;
        zoom(Math.max(o.time[0], middle - (middle - s.min) * f), Math.min(o.time[o.time.length - 1], middle + (s.max - middle) * f));
      } else if (event.key === "0" || event.key === "Escape") zoom(null);
      else return;
      event.preventDefault();
    });

    this.toggle = function () {
      plots.forEach(function (p) {
        p.batch(function () {
          p.series.forEach(function (s, k) { if (k && s.key) p.setSeries(k, { show: shown[s.key] }); });
        });
      });
    };
    this.build = build;
    this.resize = function () {
      if (plots.length && box.clientWidth && box.clientWidth !== plots[0].width)
        plots.forEach(function (p) { p.setSize({ width: box.clientWidth, height: p.height }); });
    };
    build();
  }

  document.querySelectorAll(".panel").forEach(function (figure) {
    try {
      panels.push(new Panel(figure));
    } catch (error) {
      figure.classList.add("plain"); /* the drawing without scripts stays */
      console.error(error);
    }
  });

  document.querySelectorAll(".toggles button").forEach(function (button) {
    button.addEventListener("click", function () {
      var name = button.dataset.series;
      shown[name] = !shown[name];
      button.setAttribute("aria-pressed", String(shown[name]));
      panels.forEach(function (p) { p.toggle(); });
    });
  });

  window.addEventListener("resize", function () { panels.forEach(function (p) { p.resize(); }); });

  function redraw() { panels.forEach(function (p) { p.build(); }); }

  var theme = document.getElementById("theme"), order = ["auto", "light", "dark"], chosen = root.dataset.theme || "auto";
  try { chosen = localStorage.getItem("hannes-theme") || chosen; } catch (error) { /* no storage for local files: auto */ }
  function apply(first) {
    if (chosen === "auto") delete root.dataset.theme; else root.dataset.theme = chosen;
    theme.querySelector("span").textContent = chosen;
    if (!first || chosen !== "auto") redraw();
  }
  theme.hidden = false;
  theme.addEventListener("click", function () {
    chosen = order[(order.indexOf(chosen) + 1) % order.length];
    try { localStorage.setItem("hannes-theme", chosen); } catch (error) { /* lasts until the page is closed */ }
    apply(false);
  });
  if (order.indexOf(chosen) < 0) chosen = "auto";
  apply(true);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

  document.querySelectorAll(".copy").forEach(function (button) {
    button.addEventListener("click", function () {
      var code = button.parentNode.querySelector("code");
      function done(ok) {
        button.textContent = ok ? "Copied" : "Select and copy";
        setTimeout(function () { button.textContent = "Copy"; }, 1600);
      }
      function old() {
        var range = document.createRange(), selection = getSelection();
        range.selectNodeContents(code);
        selection.removeAllRanges();
        selection.addRange(range);
        done(document.execCommand("copy"));
      }
      if (navigator.clipboard) navigator.clipboard.writeText(code.textContent).then(function () { done(true); }, old);
      else old();
    });
  });

  /* In a frame whose page answers, that page makes the frame as tall as this and scrolls: one scroll bar is enough. */
  var around = window.parent;
  function tell(what) { around.postMessage({ hannesReport: what }, "*"); }
  if (around !== window) {
    var grown = function () { tell({ height: root.offsetHeight }); };
    new ResizeObserver(grown).observe(root);
    grown(); /* a frame below the window's edge is not drawn, and not observed */
    window.addEventListener("message", function (event) {
      if (event.source === around && event.data && event.data.hannesPage) root.classList.add("framed");
    });
    document.addEventListener("click", function (event) {
      var link = event.target.closest('a[href^="#"]');
      var goal = link && document.getElementById(link.getAttribute("href").slice(1));
      if (!goal || !root.classList.contains("framed")) return;
      event.preventDefault();
      tell({ top: goal.getBoundingClientRect().top });
    });
  }

  var closed = [];
  window.addEventListener("beforeprint", function () {
    closed = Array.prototype.filter.call(document.querySelectorAll("main details"), function (d) { return !d.open; });
    closed.forEach(function (d) { d.open = true; });
  });
  window.addEventListener("afterprint", function () { closed.forEach(function (d) { d.open = false; }); });
})();
