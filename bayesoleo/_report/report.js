// Looking closer: one run at a time, and figures in full size. The page is complete without it.
(function () {
  "use strict";
  var SVG = "http://www.w3.org/2000/svg";
  var KINDS = ["measured", "before", "after"];

  function element(name, attributes, parent) {
    var made = document.createElementNS(SVG, name);
    for (var key in attributes) { made.setAttribute(key, attributes[key]); }
    if (parent) { parent.appendChild(made); }
    return made;
  }

  // Numbers of an axis: a few round ones between two ends.
  function ticks(low, high, most) {
    var raw = (high - low) / most, power = Math.pow(10, Math.floor(Math.log10(raw)));
    var step = [1, 2, 2.5, 5, 10].map(function (m) { return m * power; })
      .filter(function (s) { return s >= raw; })[0];
    var found = [];
    for (var k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
      found.push(k * step);
    }
    var digits = Math.max(0, Math.min(8, 1 - Math.floor(Math.log10(step) + 1e-9)));
    return found.map(function (value) {
      return [value, String(parseFloat(value.toFixed(digits))).replace("-", "−")];
    });
  }

  function extent(rows, x, range) {
    var low = Infinity, high = -Infinity;
    rows.forEach(function (row) {
      row.forEach(function (value, i) {
        if (value === null || x[i] === null || x[i] < range[0] || x[i] > range[1]) { return; }
        low = Math.min(low, value); high = Math.max(high, value);
      });
    });
    if (low > high) { return [-1, 1]; }
    var room = 0.07 * (high - low) || Math.abs(high) || 1;
    return [low - room, high + room];
  }

  function Viewer(box, data) {
    this.box = box;
    this.data = data;
    this.run = 0; this.output = 0; this.range = null;
    this.hidden = {};
    this.select("run", data.runs.map(function (run) { return run.label; }));
    this.select("output", data.outputs.map(function (output) { return output.name; }));
    this.buttons();
    this.canvas = box.querySelector(".canvas");
    this.readout = box.querySelector(".readout");
    box.hidden = false;
    this.draw();
    var self = this;
    window.addEventListener("resize", function () { self.draw(); });
  }

  Viewer.prototype.select = function (name, labels) {
    var self = this, list = this.box.querySelector("select." + name);
    labels.forEach(function (label, i) { list.add(new Option(label, i)); });
    list.parentNode.hidden = labels.length < 2;
    list.addEventListener("change", function () {
      self[name] = Number(list.value); self.range = null; self.draw();
    });
  };

  Viewer.prototype.step = function (by) {
    var count = this.data.runs.length;
    this.run = (this.run + by + count) % count;
    this.box.querySelector("select.run").value = this.run;
    this.range = null;
    this.draw();
  };

  Viewer.prototype.buttons = function () {
    var self = this, box = this.box;
    function on(name, act) {
      var button = box.querySelector("button." + name);
      if (button) { button.addEventListener("click", function () { act(button); }); }
      return button;
    }
    var single = this.data.runs.length < 2;
    [on("previous", function () { self.step(-1); }), on("next", function () { self.step(1); })]
      .forEach(function (button) { button.hidden = single; });
    on("closer", function () { self.zoom(0.5); });
    on("whole", function () { self.range = null; self.draw(); });
    KINDS.forEach(function (kind) {
      on(kind, function (button) {
        self.hidden[kind] = !self.hidden[kind];
        button.setAttribute("aria-pressed", String(!self.hidden[kind]));
        self.draw();
      });
    });
  };

  Viewer.prototype.full = function () {
    return this.now().ends.slice();
  };

  Viewer.prototype.now = function () { return this.data.outputs[this.output].runs[this.run]; };

  Viewer.prototype.zoom = function (part) {
    var range = this.range || this.full(), middle = (range[0] + range[1]) / 2;
    var half = part * (range[1] - range[0]) / 2;
    this.range = [middle - half, middle + half];
    this.draw();
  };

  Viewer.prototype.draw = function () {
    var width = Math.max(this.box.clientWidth, 240), now = this.now(), self = this;
    var output = this.data.outputs[this.output], run = this.data.runs[this.run];
    var narrow = width < 520;
    this.frame = { left: 58, right: width - 8, width: width };
    this.range = this.range || this.full();
    while (this.canvas.firstChild) { this.canvas.removeChild(this.canvas.firstChild); }
    var heights = narrow ? [190, 130] : [250, 150], top = 22;
    var svg = element("svg", {
      width: width, height: heights[0] + heights[1] + 126, role: "img",
      "aria-label": output.name + " of " + run.label + ": signal above, residual below",
    }, this.canvas);
    this.svg = svg;
    var shown = KINDS.filter(function (kind) { return now[kind] && !self.hidden[kind]; });
    this.panel(svg, top, heights[0], now.x, now, shown, output.labels[0], false);
    var left = shown.filter(function (kind) { return kind !== "measured"; });
    var below = top + heights[0] + 52;
    this.panel(svg, below, heights[1], now.residual.x, now.residual, left, output.labels[1], true);
    element("text", { x: (this.frame.left + width) / 2, y: below + heights[1] + 38,
      "text-anchor": "middle", class: "label" }, svg).textContent = now.x_label;
    this.readout.textContent = (run.role ? run.role + " run" : "run") +
      (run.remark ? " · " + run.remark : "") + ". " + this.readout.dataset.hint +
      (now.residual.band ? " " + this.readout.dataset.band : "");
    this.listen(svg, top, below + heights[1]);
  };

  Viewer.prototype.panel = function (svg, top, height, x, data, kinds, label, band) {
    var frame = this.frame, range = this.range, bottom = top + height;
    var rows = kinds.map(function (kind) { return data[kind]; }).filter(Boolean);
    var y = extent(rows.length ? rows : [[0]], x, range);
    if (band && data.band) { y = [Math.min(y[0], -1.2 * data.band), Math.max(y[1], 1.2 * data.band)]; }
    function px(value) {
      return frame.left + (value - range[0]) / (range[1] - range[0]) * (frame.right - frame.left);
    }
    function py(value) { return bottom - (value - y[0]) / (y[1] - y[0]) * height; }
    if (band && data.band) {
      element("rect", { x: frame.left, y: py(data.band), width: frame.right - frame.left,
        height: py(-data.band) - py(data.band), class: "band" }, svg);
    }
    ticks(y[0], y[1], height < 160 ? 4 : 5).forEach(function (tick) {
      element("line", { x1: frame.left, x2: frame.right, y1: py(tick[0]), y2: py(tick[0]),
        class: tick[0] === 0 ? "zero" : "grid" }, svg);
      element("text", { x: frame.left - 6, y: py(tick[0]) + 4, "text-anchor": "end" }, svg)
        .textContent = tick[1];
    });
    ticks(range[0], range[1], frame.width < 520 ? 4 : 8).forEach(function (tick) {
      element("text", { x: px(tick[0]), y: bottom + 17, "text-anchor": "middle" }, svg)
        .textContent = tick[1];
    });
    element("text", { x: 0, y: top - 8, class: "label" }, svg).textContent = label;
    kinds.forEach(function (kind) {
      if (data[kind]) { line(svg, x, data[kind], px, py, kind, range); }
    });
  };

  function line(svg, x, y, px, py, kind, range) {
    var path = "", dots = [], open = false;
    x.forEach(function (value, i) {
      // A point beyond each edge stays, so that lines reach the edge.
      var outside = value === null || y[i] === null ||
        (i + 1 < x.length && x[i + 1] < range[0]) || (i > 0 && x[i - 1] > range[1]);
      if (outside) { open = false; return; }
      var a = px(value).toFixed(1), b = py(y[i]).toFixed(1);
      path += (open ? "L" : "M") + a + " " + b;
      open = true;
      if (value >= range[0] && value <= range[1]) { dots.push([a, b]); }
    });
    element("path", { d: path, class: "line " + kind, "clip-path": "url(#panel)" }, svg);
    if (dots.length <= 80) {
      dots.forEach(function (dot) {
        element("circle", { cx: dot[0], cy: dot[1], r: kind === "measured" ? 3.5 : 2,
          class: "dot " + kind }, svg);
      });
    }
  }

  // Drag across to enlarge; double click for the whole record; values under the pointer.
  Viewer.prototype.listen = function (svg, top, bottom) {
    var self = this, frame = this.frame, start = null;
    var definitions = element("defs", {}, svg);
    var clip = element("clipPath", { id: "panel" }, definitions);
    element("rect", { x: frame.left, y: 0, width: frame.right - frame.left, height: bottom + 40 }, clip);
    var drawn = element("rect", { y: top, height: bottom - top, width: 0, class: "drag" }, svg);
    var cross = element("line", { y1: top, y2: bottom, class: "cross", x1: -9, x2: -9 }, svg);
    function place(event) {
      var x = event.clientX - svg.getBoundingClientRect().left;
      return Math.min(Math.max(x, frame.left), frame.right);
    }
    function value(pixel) {
      return self.range[0] + (pixel - frame.left) / (frame.right - frame.left) *
        (self.range[1] - self.range[0]);
    }
    svg.addEventListener("pointerdown", function (event) {
      start = place(event); svg.setPointerCapture(event.pointerId);
    });
    svg.addEventListener("pointermove", function (event) {
      var x = place(event);
      if (start !== null) {
        drawn.setAttribute("x", Math.min(start, x));
        drawn.setAttribute("width", Math.abs(x - start));
        return;
      }
      cross.setAttribute("x1", x); cross.setAttribute("x2", x);
      self.read(value(x));
    });
    svg.addEventListener("pointerup", function (event) {
      var from = start, x = place(event);
      start = null;
      if (from === null || Math.abs(x - from) < 8) { drawn.setAttribute("width", 0); return; }
      self.range = [value(Math.min(from, x)), value(Math.max(from, x))];
      self.draw();
    });
    svg.addEventListener("pointercancel", function () { start = null; drawn.setAttribute("width", 0); });
    svg.addEventListener("dblclick", function () { self.range = null; self.draw(); });
  };

  Viewer.prototype.read = function (at) {
    var now = this.now(), best = -1, self = this;
    now.x.forEach(function (value, i) {
      if (value !== null && (best < 0 || Math.abs(value - at) < Math.abs(now.x[best] - at))) { best = i; }
    });
    if (best < 0) { return; }
    var unit = this.data.outputs[this.output].unit;
    var texts = KINDS.filter(function (kind) {
      return now[kind] && now[kind][best] !== null && !self.hidden[kind];
    }).map(function (kind) { return self.data.words[kind] + " " + shown(now[kind][best]); });
    this.readout.textContent = now.x_label + " " + shown(now.x[best]) + ": " + texts.join(", ") +
      (unit ? " " + unit : "");
  };

  function shown(value) { return String(parseFloat(value.toPrecision(4))).replace("-", "−"); }

  // A figure in full size, to be moved with the fingers or the scroll bars.
  function enlarge(image) {
    var box = document.createElement("div");
    box.className = "enlarged";
    box.setAttribute("role", "dialog");
    box.setAttribute("aria-label", "figure, enlarged");
    var close = document.createElement("button");
    close.type = "button"; close.textContent = "Close";
    var copy = image.cloneNode();
    copy.removeAttribute("style");
    copy.style.width = Math.max(1400, 1.5 * window.innerWidth) + "px";
    box.appendChild(close); box.appendChild(copy);
    function end() {
      document.removeEventListener("keydown", key);
      box.remove(); image.focus();
    }
    function key(event) { if (event.key === "Escape") { end(); } }
    close.addEventListener("click", end);
    copy.addEventListener("click", end);
    document.addEventListener("keydown", key);
    document.body.appendChild(box);
    close.focus();
  }

  document.querySelectorAll("figure img").forEach(function (image) {
    image.tabIndex = 0;
    image.classList.add("zooms");
    image.title = "Click to enlarge";
    image.addEventListener("click", function () { enlarge(image); });
    image.addEventListener("keydown", function (event) {
      if (event.key === "Enter") { enlarge(image); }
    });
  });
  var data = document.getElementById("runs-data"), box = document.getElementById("viewer");
  if (data && box) { window.viewer = new Viewer(box, JSON.parse(data.textContent)); }
  document.addEventListener("toggle", function () { window.dispatchEvent(new Event("resize")); }, true);
}());
