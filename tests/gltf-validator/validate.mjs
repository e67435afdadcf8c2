// Checks glTF files with the Khronos validator.
//
//   node validate.mjs FILE...
//
// Prints every error and warning. Exit status 0 when no file has an error, else 1.

import { readFile } from 'node:fs/promises';
import { dirname, join } from 'node:path';
import validator from 'gltf-validator';

const SEVERITIES = ['error', 'warning'];

async function validate(path) {
  const report = await validator.validateBytes(new Uint8Array(await readFile(path)), {
    maxIssues: 100,
    externalResourceFunction: async (uri) =>
      new Uint8Array(await readFile(join(dirname(path), decodeURIComponent(uri)))),
  });
  for (const issue of report.issues.messages) {
    if (issue.severity < SEVERITIES.length) {
      const place = issue.pointer ?? `byte ${issue.offset}`;
      console.log(`${path}: ${SEVERITIES[issue.severity]} ${issue.code} at ${place}: ${issue.message}`);
    }
  }
  const { numErrors, numWarnings } = report.issues;
  console.log(`${path}: ${numErrors} errors, ${numWarnings} warnings`);
  return numErrors === 0;
}

let valid = true;
for (const path of process.argv.slice(2)) {
  valid = (await validate(path)) && valid;
}
process.exitCode = valid ? 0 : 1;
