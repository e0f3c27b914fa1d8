// What can be done with a job, each with its question where there is no way back.

import { del, post, toast } from "./api.js";
import { ask, h } from "./dom.js";
import { hasEnded, nameOf } from "./format.js";

/** @import { Job } from "./api.js" */

const { who, role } = document.body.dataset;

/**
 * Whether whoever looks may change the job: its owner, or an administrator.
 * @param {Job} job
 */
export const mayChange = (job) => role === "admin" || who === job.owner;

/**
 * Whether a running job is about to be cancelled.
 * @param {Job} job
 */
export const isCancelling = (job) => job.state === "running" && job.reason === "cancelling";

/** @typedef {"cancel" | "retry" | "delete"} Action */

/**
 * The actions that the job's state allows.
 * @param {Job} job
 * @returns {Action[]}
 */
export function actionsOf(job) {
  if (!mayChange(job)) return [];
  if (!hasEnded(job.state)) return isCancelling(job) ? [] : ["cancel"];
  return job.state === "done" ? ["delete"] : ["retry", "delete"];
}

/**
 * A button for an action; `done(action)` is called after it went well.
 * @param {Job} job
 * @param {Action} action
 * @param {((action: Action) => void) | null} done
 */
export function actionButton(job, action, done, size = "small") {
  const act = { cancel, retry, delete: remove }[action];
  const about = { cancel: "Cancel", retry: "Retry", delete: "Delete" }[action];
  const onclick = async (/** @type {Event & { currentTarget: HTMLButtonElement }} */ event) => {
    const button = event.currentTarget;
    button.disabled = true;
    try {
      if (await act(job)) done?.(action);
    } catch (error) {
      toast(error);
    }
    button.disabled = false;
  };
  if (action === "delete") {
    const label = `Delete ${nameOf(job)}`;
    return h("button", { type: "button", class: "icon", title: "Delete", "aria-label": label, onclick, dataset: { action } }, bin());
  }
  return h("button", { type: "button", class: `button ${size}`, "aria-label": `${about} ${nameOf(job)}`, onclick, dataset: { action } }, about);
}

/** @param {Job} job */
async function cancel(job) {
  const text = `“${nameOf(job)}” stops. What is done so far is kept: Retry goes on from there.`;
  if (job.state === "running" && !(await ask({ title: "Cancel this job?", text, action: "Cancel the job", danger: true }))) return false;
  await post(`/jobs/${job.id}/cancel`);
  return true;
}

/** @param {Job} job */
async function retry(job) {
  await post(`/jobs/${job.id}/retry`);
  toast(`“${nameOf(job)}” is in the queue again and goes on from what is done.`, "good");
  return true;
}

/** @param {Job} job */
async function remove(job) {
  const answer = await ask({
    title: "Delete this job?",
    text: `“${nameOf(job)}” leaves the list, with its log and its versions of columns. This cannot be undone. The movie itself is never touched.`,
    action: "Delete",
    danger: true,
    checkbox: `Delete its results in ${job.output}, too`,
  });
  if (!answer) return false;
  const { kept } = await del(`/jobs/${job.id}`, { files: answer.checked || undefined });
  toast(kept ? `The job is deleted; its folder was kept: ${kept}` : "The job is deleted.", kept ? "" : "good");
  return true;
}

function bin() {
  const icon = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  for (const [name, value] of Object.entries({ viewBox: "0 0 20 20", width: "17", height: "17", "aria-hidden": "true" })) icon.setAttribute(name, value);
  const path = document.createElementNS(icon.namespaceURI, "path");
  const drawn = { d: "M4 6h12M8 6V4h4v2M6 6l.7 10h6.6L14 6M8.5 9v4.5M11.5 9v4.5", fill: "none", stroke: "currentColor", "stroke-width": "1.4", "stroke-linecap": "round", "stroke-linejoin": "round" };
  for (const [name, value] of Object.entries(drawn)) path.setAttribute(name, value);
  icon.append(path);
  return icon;
}
