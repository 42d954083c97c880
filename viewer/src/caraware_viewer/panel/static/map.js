// The map of a live run on a canvas: a click chooses a vehicle, or the nearest road.

import { byId } from "./dom.js";

const COLORS = { cav: "#4da3ff", hero: "#ff5fa2", other: "#c9ccd2", person: "#f0b35a" };
const ROAD_KINDS = new Set(["car", "bus"]);
const CHOICE_PIXELS = 18;

const canvas = byId("map");
const pen = canvas.getContext("2d");
let map = null;
let users = [];
let chosen = "";
let edge = null;
/** Metres at the centre of the canvas, and pixels per metre. */
let view = { x: 0, y: 0, scale: 1 };
let drag = null;

/** Place on the canvas of a place in the world. */
export const toCanvas = (x, y) => [canvas.width / 2 + (x - view.x) * view.scale, canvas.height / 2 - (y - view.y) * view.scale];
const toWorld = (x, y) => [view.x + (x - canvas.width / 2) / view.scale, view.y - (y - canvas.height / 2) / view.scale];

/** Place on the canvas of a mouse event; the canvas is drawn at another size than it is shown. */
function place(event) {
  const box = canvas.getBoundingClientRect();
  return [((event.clientX - box.left) * canvas.width) / box.width, ((event.clientY - box.top) * canvas.height) / box.height];
}

export function showMap(next) {
  map = next;
  users = [];
  if (map) {
    const [left, bottom, right, top] = map.bounds_m;
    view = { x: (left + right) / 2, y: (bottom + top) / 2,
      scale: 0.96 * Math.min(canvas.width / (right - left || 1), canvas.height / (top - bottom || 1)) };
  }
  draw();
}

export function showUsers(next, chosenId) {
  users = next;
  chosen = chosenId;
  draw();
}

export const shownMap = () => map;

/** The edge of a road whose centre line is nearest to a place, metres. */
export function nearestEdge(x, y) {
  let nearest = { distance: Infinity, edge: null };
  for (const lane of map?.lanes ?? []) {
    if (lane.inside || !ROAD_KINDS.has(lane.kind)) continue;
    for (let at = 1; at < lane.points_m.length; at += 1) {
      const distance = distanceTo(x, y, lane.points_m[at - 1], lane.points_m[at]);
      if (distance < nearest.distance) nearest = { distance, edge: lane.edge };
    }
  }
  return nearest.edge;
}

function distanceTo(x, y, [ax, ay], [bx, by]) {
  const [dx, dy] = [bx - ax, by - ay];
  const share = Math.max(0, Math.min(1, ((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy || 1)));
  return Math.hypot(x - ax - share * dx, y - ay - share * dy);
}

function line(points, width, color) {
  pen.beginPath();
  for (const [x, y] of points) pen.lineTo(...toCanvas(x, y));
  pen.lineWidth = Math.max(1, width);
  pen.strokeStyle = color;
  pen.stroke();
}

function draw() {
  pen.clearRect(0, 0, canvas.width, canvas.height);
  if (!map) return;
  pen.fillStyle = "#3a332c";
  for (const building of map.buildings) {
    pen.beginPath();
    for (const [x, y] of building) pen.lineTo(...toCanvas(x, y));
    pen.fill();
  }
  for (const lane of map.lanes) {
    const color = lane.edge === edge ? "#2f6d3a" : ROAD_KINDS.has(lane.kind) ? "#3d424c" : "#2a2d33";
    line(lane.points_m, lane.width_m * view.scale, color);
  }
  for (const user of users) {
    const [x, y] = toCanvas(user.x_m, user.y_m);
    pen.fillStyle = COLORS[user.kind] ?? COLORS.other;
    pen.beginPath();
    pen.arc(x, y, user.kind === "person" ? 2 : Math.max(3, Math.min(7, 2 * view.scale)), 0, 2 * Math.PI);
    pen.fill();
    pen.beginPath();
    pen.moveTo(x, y);
    pen.lineTo(x + 10 * Math.cos(user.yaw_rad), y - 10 * Math.sin(user.yaw_rad));
    pen.lineWidth = 1.5;
    pen.strokeStyle = pen.fillStyle;
    if (user.kind !== "person") pen.stroke();
    if (user.id !== chosen) continue;
    pen.beginPath();
    pen.arc(x, y, 11, 0, 2 * Math.PI);
    pen.strokeStyle = "#ffffff";
    pen.stroke();
    pen.fillStyle = "#ffffff";
    pen.font = "13px system-ui";
    pen.fillText(user.id, x + 13, y - 8);
  }
}

/** Calls `onVehicle(id)` for a click while `placing()` is empty, else `onEdge(edge)`. */
export function listenToMap(placing, onVehicle, onEdge) {
  canvas.addEventListener("pointerdown", (event) => {
    drag = { x: event.clientX, y: event.clientY, moved: false };
  });
  canvas.addEventListener("pointermove", (event) => {
    if (drag && event.buttons === 1) {
      drag.moved ||= Math.hypot(event.clientX - drag.x, event.clientY - drag.y) > 4;
      if (drag.moved) {
        const factor = canvas.width / canvas.getBoundingClientRect().width / view.scale;
        view.x -= event.movementX * factor;
        view.y += event.movementY * factor;
      }
    }
    edge = placing() ? nearestEdge(...toWorld(...place(event))) : null;
    draw();
  });
  canvas.addEventListener("pointerleave", () => {
    edge = null;
    draw();
  });
  canvas.addEventListener("click", (event) => {
    if (!map || drag?.moved) return;
    const [x, y] = place(event);
    if (placing()) {
      const nearest = nearestEdge(...toWorld(x, y));
      if (nearest) onEdge(nearest);
      return;
    }
    const distance = (user) => Math.hypot(toCanvas(user.x_m, user.y_m)[0] - x, toCanvas(user.x_m, user.y_m)[1] - y);
    const vehicles = users.filter((user) => user.kind !== "person" && distance(user) < CHOICE_PIXELS);
    vehicles.sort((one, other) => distance(one) - distance(other));
    if (vehicles.length) onVehicle(vehicles[0].id);
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const [x, y] = place(event);
    const [worldX, worldY] = toWorld(x, y);
    view.scale *= Math.exp(-event.deltaY * 0.0015);
    view.x = worldX - (x - canvas.width / 2) / view.scale;
    view.y = worldY + (y - canvas.height / 2) / view.scale;
    draw();
  }, { passive: false });
}
