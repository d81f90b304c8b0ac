"""Script of test_hub: all that `datasets` finds in a folder, as JSON; arguments: folder, shards, cache."""

import json
import sys

import datasets

folder, shards, cache = sys.argv[1], sys.argv[2].split(","), sys.argv[3]
found = {}
plain = datasets.load_dataset("webdataset", data_files={"train": shards}, cache_dir=cache, split="train")
found["plain"] = [row["__key__"] for row in plain]
whole = datasets.load_dataset(folder, cache_dir=cache)
found["default"] = {split: [row["__key__"] for row in rows] for split, rows in whole.items()}
held_out = datasets.load_dataset(folder, "test", cache_dir=cache, split="test")
found["columns"] = [plain.column_names, held_out.column_names]
row = plain[0]
found["exr"] = row["f01.rgb.exr"].hex()
found["meta"] = row["meta.json"]
found["lights"] = [each["meta.json"]["extra"]["light_spec"] for each in plain]
streamed = datasets.load_dataset(folder, split="train", streaming=True, cache_dir=cache)
found["streamed"] = [row["__key__"] for row in streamed]
print(json.dumps(found))
