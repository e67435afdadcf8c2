"""Runs the queries in schemas/queries on a dataset with DuckDB and prints their results as JSON.

    python query_dataset.py DATASET

DATASET is the folder of a published dataset. The views hold exactly the files that the current
manifest names, so files of older datasets in the same folder do not count. Needs the `duckdb`
package from PyPI (tried with 2.0) and no extension. Exit status 0, or 1 with a message.
"""

import json
import pathlib
import sys

import duckdb

QUERIES = pathlib.Path(__file__).resolve().parents[2] / "schemas" / "queries"


def current_manifest(dataset: pathlib.Path) -> dict:
    """The manifest that the dataset's pointer names."""
    pointer = json.loads((dataset / "current.json").read_text())
    path = dataset / "manifests" / f"{pointer['manifest']:08}.json"
    return json.loads(path.read_text())


def connect(dataset: pathlib.Path, manifest: dict) -> duckdb.DuckDBPyConnection:
    """A connection with one view a kind of file: cells, objects, index_, scene, numbering, meshes."""
    connection = duckdb.connect()
    paths: dict[str, list[str]] = {}
    for file in manifest["files"]:
        paths.setdefault(file["kind"], []).append(str(dataset / file["name"]))
    for kind, files in paths.items():
        view = "index_" if kind == "index" else kind
        connection.read_parquet(files).create_view(view)
    return connection


def run(connection: duckdb.DuckDBPyConnection, name: str) -> list[dict]:
    """The rows of schemas/queries/<name>.sql."""
    relation = connection.sql((QUERIES / f"{name}.sql").read_text())
    return [dict(zip(relation.columns, row)) for row in relation.fetchall()]


def main() -> int:
    if len(sys.argv) != 2:
        print(__doc__, file=sys.stderr)
        return 1
    dataset = pathlib.Path(sys.argv[1])
    try:
        manifest = current_manifest(dataset)
    except OSError as error:
        print(f"{dataset} is not a published dataset: {error}", file=sys.stderr)
        return 1
    with connect(dataset, manifest) as connection:
        result = {
            "cells": manifest["cells"],
            "top_objects": run(connection, "top_objects") if manifest["cells"] else [],
            "set_size_histogram": run(connection, "set_size_histogram") if manifest["cells"] else [],
        }
    json.dump(result, sys.stdout, indent=2)
    print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
