// A strip chart of the barrier h towards the nearest pursuer, with the shield's corrections under it.

const SPAN = 20; // s shown

export class Chart {
  constructor(canvas) {
    this.canvas = canvas;
    this.points = [];
    this.width = 0;
  }

  clear() {
    this.points = [];
  }

  take(frame, speed) {
    if (!frame.h || frame.pace === 0) return;
    if (frame.cut || (this.points.length && frame.time < this.points.at(-1).time)) this.points = [];
    this.points.push({
      time: frame.time,
      h: Math.min(...frame.h),
      share: Math.min(frame.intervention / (2 * speed), 1),
      lost: frame.status === "infeasible",
    });
    while (this.points.length && this.points[0].time < frame.time - SPAN - 1) this.points.shift();
  }

  draw(colours) {
    const { canvas } = this;
    const ratio = devicePixelRatio || 1;
    const width = canvas.clientWidth;
    const height = canvas.clientHeight;
    if (!width || !height) return;
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio);
      canvas.height = Math.round(height * ratio);
    }
    const pen = canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, width, height);
    const left = 8;
    const right = width - 8;
    const top = 20;
    const floor = height - 26;
    const bars = height - 6;
    const now = this.points.length ? this.points.at(-1).time : 0;
    const x = (time) => right - ((now - time) / SPAN) * (right - left);
    const most = 0.6;
    const y = (h) => floor - (Math.max(Math.min(h, most), -0.03) / most) * (floor - top);
    pen.font = "600 11px system-ui, sans-serif";
    pen.textBaseline = "alphabetic";
    pen.fillStyle = colours.soft;
    pen.textAlign = "left";
    pen.fillText("distance to capture  h", left, 12);
    pen.textAlign = "right";
    const last = this.points.at(-1);
    if (last) {
      pen.fillStyle = last.h < 0.02 ? colours.pursuer : colours.evaderText;
      pen.fillText(last.h < 0.01 ? `${(1000 * last.h).toFixed(1)} mm` : `${last.h.toFixed(2)} m`, right, 12);
    }
    pen.lineWidth = 1;
    for (const level of [0.2, 0.4]) {
      pen.strokeStyle = colours.grid;
      pen.beginPath();
      pen.moveTo(left, y(level));
      pen.lineTo(right, y(level));
      pen.stroke();
    }
    pen.strokeStyle = colours.pursuer;
    pen.setLineDash([4, 3]);
    pen.beginPath();
    pen.moveTo(left, y(0));
    pen.lineTo(right, y(0));
    pen.stroke();
    pen.setLineDash([]);
    if (this.points.length > 1) {
      pen.save();
      pen.beginPath();
      pen.rect(left, 0, right - left, height);
      pen.clip();
      pen.beginPath();
      pen.moveTo(x(this.points[0].time), y(0));
      for (const point of this.points) pen.lineTo(x(point.time), y(point.h));
      pen.lineTo(x(last.time), y(0));
      pen.closePath();
      pen.fillStyle = colours.evaderFaint;
      pen.fill();
      pen.beginPath();
      for (const point of this.points) pen.lineTo(x(point.time), y(point.h));
      pen.strokeStyle = colours.evader;
      pen.lineWidth = 1.8;
      pen.lineJoin = "round";
      pen.stroke();
      const step = Math.max(((right - left) / SPAN) * 0.05, 1);
      for (const point of this.points) {
        if (point.share <= 0.002) continue;
        pen.fillStyle = point.lost ? colours.pursuer : colours.correction;
        const tall = 3 + 13 * Math.sqrt(point.share);
        pen.fillRect(x(point.time) - step / 2, bars - tall, step + 0.4, tall);
      }
      pen.restore();
    }
    pen.fillStyle = colours.soft;
    pen.textAlign = "left";
    pen.font = "10px system-ui, sans-serif";
    const words = "shield's corrections";
    const wide = pen.measureText(words).width;
    const busy = this.points.some((point) => point.share > 0.002 && x(point.time) < left + wide + 8);
    if (!busy) pen.fillText(words, left, bars - 2);
  }
}
