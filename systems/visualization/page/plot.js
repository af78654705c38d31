// Curves of several flights over time, with axes.
"use strict";

class Plot {
  // `name`: of the values of a flight; `margin`: value below which the ground is red, or null.
  constructor(panel, id, {name, title, margin}, replay) {
    Object.assign(this, {name, title, margin, replay});
    this.canvas = addElement(panel, "canvas", {width: 648, height: 230, id});
    this.canvas.onclick = ({offsetX}) => replay.seek(
      this.time(offsetX / this.canvas.clientWidth * this.canvas.width));
    const known = replay.flights.flatMap((flight) => flight[name].filter((v) => v !== null));
    this.top = known.reduce((a, b) => Math.max(a, b), 1);
    this.bottom = known.reduce((a, b) => Math.min(a, b), 0);
  }

  x(time) {
    return 56 + time / this.replay.duration * (this.canvas.width - 72);
  }

  time(x) {
    return (x - 56) / (this.canvas.width - 72) * this.replay.duration;
  }

  y(value) {
    return 34 + (this.top - value) / (this.top - this.bottom) * (this.canvas.height - 66);
  }

  // Round values from `low` to `high`, about `count`.
  static ticks(low, high, count) {
    const raw = (high - low) / count, decade = 10 ** Math.floor(Math.log10(raw));
    const step = decade * ([1, 2, 5].find((factor) => factor * decade >= raw) ?? 10);
    const first = Math.ceil(low / step - 1e-9);
    return Array.from({length: Math.floor(high / step + 1e-9) - first + 1},
      (_, k) => +((first + k) * step).toPrecision(6));
  }

  draw() {
    const {canvas, replay, name} = this, context = canvas.getContext("2d");
    const {width, height} = canvas, low = this.y(this.bottom), high = this.y(this.top);
    context.fillStyle = "#15171b";
    context.fillRect(0, 0, width, height);
    if (this.margin !== null) {
      context.fillStyle = "rgba(255, 32, 32, 0.3)";
      context.fillRect(56, this.y(this.margin), width - 72, low - this.y(this.margin));
    }
    context.font = "20px system-ui, sans-serif";
    context.fillStyle = "#bbb";
    context.strokeStyle = "#444";
    context.lineWidth = 1;
    const line = (...points) => {
      context.beginPath();
      for (const point of points) context.lineTo(...point);
      context.stroke();
    };
    context.textAlign = "right";
    for (const value of Plot.ticks(this.bottom, this.top, 4)) {
      line([56, this.y(value)], [width - 16, this.y(value)]);
      context.fillText(`${value}`, 50, this.y(value) + 7);
    }
    context.textAlign = "center";
    for (const time of Plot.ticks(0, replay.duration, 6)) {
      line([this.x(time), low], [this.x(time), low + 6]);
      context.fillText(`${time}`, this.x(time), height - 6);
    }
    context.textAlign = "right";
    context.fillText("s", width - 2, height - 6);
    for (const flight of [...replay.flights].sort((a, b) => a.chosen - b.chosen)) {
      context.strokeStyle = flight.color;
      context.lineWidth = flight.chosen ? 4 : 2;
      let points = [];
      const values = [...flight[name], null];
      values.forEach((value, i) => {
        if (value !== null) points.push([this.x(flight.times[i]), this.y(value)]);
        else {
          line(...points);
          points = [];
        }
      });
    }
    context.fillStyle = "#fff";
    context.fillRect(this.x(replay.time) - 1, high, 3, low - high);
    const value = replay.chosen.value(name, replay.time);
    context.textAlign = "left";
    context.fillText(this.title, 8, 22);
    context.textAlign = "right";
    context.fillText(value === null ? "–" : value.toFixed(2), width - 16, 22);
  }
}
