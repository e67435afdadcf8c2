// Validates glTF files with the Khronos validator: `node validate.mjs FILE...`.
// Prints every error as one line and exits with 1 when there is one.
import { readFile } from "node:fs/promises";
import validator from "gltf-validator";

let errors = 0;
for (const file of process.argv.slice(2)) {
  const bytes = new Uint8Array(await readFile(file));
  const report = await validator.validateBytes(bytes, { maxIssues: 0 });
  for (const issue of report.issues.messages.filter((m) => m.severity === 0)) {
    console.log(`${file}: ${issue.pointer ?? issue.offset}: ${issue.code}: ${issue.message}`);
  }
  errors += report.issues.numErrors;
}
process.exit(errors > 0 ? 1 : 0);
