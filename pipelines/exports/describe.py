"""What an export says of itself: croissant.json (Croissant 1.1 with its responsible-AI terms) and a dataset card.

All of it comes from the store's facts; there is no date in it, so equal stores give equal bytes.
"""

from collections import Counter
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import orjson
import pyarrow as pa
import pyarrow.parquet as pq

from hoidata.dataset_folders import dataset_facts
from hoidata.files import sha256_file
from hoidata.store.fields import STORE_FILES, StoreFile
from hoidata.store.store import Store
from pipelines.exports.licences import OWN_USE, ArrayLicence, licences_of

CROISSANT = "http://mlcommons.org/croissant/1.1"
RESPONSIBLE = "http://mlcommons.org/croissant/RAI/1.0"
HOMEPAGE = "https://schema.org/Dataset"  # where a dataset names no page of its own
_ENCODINGS = {
    ".parquet": "application/x-parquet",
    ".json": "application/json",
    ".tar": "application/x-tar",
    ".glb": "model/gltf-binary",
    ".usdc": "model/vnd.usd",
    ".npz": "application/x-npz",
}
_TYPES = {
    "string": "sc:Text", "bool": "sc:Boolean", "int32": "cr:Int32", "int64": "cr:Int64", "float": "cr:Float32",
    "double": "cr:Float64", "uint8": "cr:UInt8",
}  # fmt: skip
_CR = ("citeAs", "column", "containedIn", "equivalentProperty", "extract", "field", "fileProperty", "fileObject",
       "fileSet", "format", "includes", "isArray", "arrayShape", "isLiveDataset", "jsonPath", "key", "md5",
       "parentField", "path", "recordSet", "references", "regex", "repeated", "replace", "samplingRate", "separator",
       "source", "subField", "transform")  # fmt: skip
CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "name": {"@container": "@language"},
    "description": {"@container": "@language"},
    **{name: f"cr:{name}" for name in _CR},
}


def write_description(folder: Path, store: Store, to: str, meaning: str, for_own_use: bool) -> None:
    """Write croissant.json and README.md into ``folder``, about the files there; for ``croissant`` about the store."""
    root = store.folder if to == "croissant" else folder
    described = croissant(root, store, meaning, for_own_use)
    (folder / "croissant.json").write_bytes(orjson.dumps(described, option=orjson.OPT_INDENT_2) + b"\n")
    (folder / "README.md").write_text(dataset_card(root, store, meaning, for_own_use), encoding="utf-8")


def croissant(root: Path, store: Store, meaning: str, for_own_use: bool) -> dict[str, Any]:
    """The description of the files below ``root``, as JSON-LD; their addresses are relative to it."""
    info, name = store.info, _name(store)
    files = [path for path in sorted(root.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    facts = dataset_facts(str(info["dataset"]))
    rows = licences_of(info)
    described: dict[str, Any] = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [CROISSANT, RESPONSIBLE],
        "name": name,
        "description": f"{_summary(store)} {meaning[0].upper()}{meaning[1:]}.",
        "license": list(dict.fromkeys(map(_licence_address, rows))),
        "url": _address(str(info.get("where_to_register", ""))),
        "version": _version(str(info["dataset_version"])),
        "keywords": ["hand-object interaction", "motion", "MANO", str(info["dataset"])],
        "citeAs": facts.paper if facts and facts.paper else name,
        **{f"rai:{key}": value for key, value in _responsible(store).items()},
    }
    if for_own_use:
        described["usageInfo"] = OWN_USE
    described["distribution"] = [_file_object(root, path, rows) for path in files]
    described["recordSet"] = [_record_set(root, path) for path in files if path.suffix == ".parquet"]
    return described


def dataset_card(root: Path, store: Store, meaning: str, for_own_use: bool) -> str:
    """README.md with the front matter Hugging Face reads: licence, files of each subset; and the licence per array."""
    info, rows = store.info, licences_of(store.info)
    data = sorted((root / "data").glob("*.parquet"))
    spdx = rows[0].spdx
    known = {"CC0-1.0": "cc0-1.0"}.get(spdx, spdx.lower() if spdx.startswith("CC-") else "other")
    lines = ["---", f"pretty_name: {_name(store)}", f"license: {known}"]
    lines += [f"license_name: {spdx.lower()}"] if known == "other" else []
    lines += ["tags:", "- hand-object-interaction", "- robotics", "- 3d"]
    if data:
        lines += ["configs:", "- config_name: default", "  data_files:"]
        lines += [line for path in data for line in (f"  - split: {path.stem}", f"    path: data/{path.name}")]
    lines += ["---", "", f"# {_name(store)}", "", _summary(store), "", f"{meaning[0].upper()}{meaning[1:]}.", ""]
    if for_own_use:
        lines += [f"**Exported {OWN_USE}.**", ""]
    lines += ["## Licence per array", "", "| arrays | what | SPDX | may be passed on |", "|---|---|---|---|"]
    lines += [f"| {r.kind.name} | {r.kind.meaning} | {r.spdx} | {'yes' if r.may_be_shared else 'no'} |" for r in rows]
    lines += ["", *(f"- {r.spdx}: {r.licence}" for r in {row.spdx: row for row in rows}.values())]
    lines += ["", "## How it came about", ""]
    lines += [f"- {key}: {'; '.join(value) if isinstance(value, list) else value}" for key, value in
              _responsible(store).items()]  # fmt: skip
    lines += ["", f"Units: metre, radian, second; {info['fps']} frames per second; column vectors; world right-handed."]
    return "\n".join(lines) + "\n"


def _responsible(store: Store) -> dict[str, Any]:
    """Croissant's responsible-AI terms that the facts of a store can fill."""
    info, counts, rows = store.info, store.info["counts"], store.sequences
    facts = dataset_facts(str(info["dataset"]))
    errors_m = rows["fit_error_m"].dropna().tolist()  # of hands fitted to keypoints
    verbs = Counter(rows["verb"].dropna().tolist())
    source = facts.paper if facts and facts.paper else info["dataset"]
    limits = [f"gravity: {info['frame']['gravity']}"]
    if errors_m:
        error_mm = 1000 * sum(errors_m) / len(errors_m)
        limits.append(f"hands of {len(errors_m)} clips are fitted to keypoints, mean error {error_mm:.1f} mm")
    made = "generated by code in the raw format of" if info["synthetic"] else "recorded by the authors of"
    return {
        "dataCollection": f"{made[0].upper()}{made[1:]} {source}; {counts['files']} raw files",
        "dataCollectionType": ["Synthetic data"] if info["synthetic"] else ["Physical data collection"],
        "dataCollectionRawData": str(info.get("where_to_register", "see dataCollection")),
        "dataCollectionMissingData": (
            f"{counts['quarantined']} sequences or intervals are left out, with reasons in quarantine.parquet; "
            "frames in which a hand is not tracked are marked, their numbers mean nothing"
        ),
        "dataPreprocessingProtocol": [
            f"resampled from {info['source_fps']:g} to {info['fps']} frames per second, metres, right-handed world",
            f"hands: {info['hand_convention']['note']}; stored with absolute angles, hand model "
            f"{info['hand_model']['name']}",
        ],
        "dataAnnotationProtocol": "verbs and objects as labelled by the source; sentences are made from them by rules",
        "dataBiases": [
            f"{rows['subject'].nunique()} subjects, {counts['objects']} objects, {len(verbs)} verbs; most frequent: "
            + ", ".join(f"{verb} ({count})" for verb, count in sorted(verbs.items(), key=_by_count)[:3])
        ],
        "dataLimitations": limits,
        "dataUseCases": ["training and evaluation of models of hand-object motion"],
        "personalSensitiveInformation": (
            ["none: no person was recorded"] if info["synthetic"] else
            ["motion and shape of hands of persons known by the source's ids"]
        ),
    }  # fmt: skip


def _by_count(pair: tuple[Any, int]) -> tuple[int, str]:
    return -pair[1], str(pair[0])


def _name(store: Store) -> str:
    return f"hoidata-{store.info['dataset']}{'-synthetic' if store.info['synthetic'] else ''}"


def _summary(store: Store) -> str:
    info, counts = store.info, store.info["counts"]
    kind = "Synthetic hand-object interaction" if info["synthetic"] else "Hand-object interaction"
    return (
        f"{kind} in the conventions of {info['dataset']}: {counts['clips']} clips, {counts['frames']} frames, "
        f"{counts['objects']} objects."
    )


def _version(text: str) -> str:
    """As Croissant wants it, major.minor.patch."""
    numbers = text.split(".")
    return ".".join([*numbers, "0", "0"][:3]) if all(map(str.isdigit, numbers)) else "0.0.0"


def _address(where: str) -> str:
    """The first address in ``where``; Croissant asks for one."""
    found = [word.strip("(),;") for word in where.split() if word.startswith("https://")]
    return found[0] if found else HOMEPAGE


def _licence_address(row: ArrayLicence) -> str:
    return row.licence if row.spdx.startswith("LicenseRef") else f"https://spdx.org/licenses/{row.spdx}.html"


def _file_object(root: Path, path: Path, rows: tuple[ArrayLicence, ...]) -> dict[str, Any]:
    name = path.relative_to(root).as_posix()
    described: dict[str, Any] = {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{path.stat().st_size} B",
        "encodingFormat": _ENCODINGS.get(path.suffix, "application/octet-stream"),
        "sha256": sha256_file(path),
    }
    if file := next((file for file in STORE_FILES if fnmatch(name, file.path)), None):
        described["description"] = _about(file, rows)
    return described


def _about(file: StoreFile, rows: tuple[ArrayLicence, ...]) -> str:
    """Meaning and licence of a file of a store, and of its arrays where it is no table."""
    here = [row for row in rows if file.path in row.kind.arrays]
    licences = ", ".join(dict.fromkeys(row.spdx for row in here))
    arrays = [f"{f.name} {f.dtype}: {f.meaning}{f', {f.unit}' if f.unit else ''}" for f in file.fields]
    listed = f" Arrays: {'; '.join(arrays)}." if file.path.endswith(".npz") else ""
    return f"{file.meaning}.{f' Licence: {licences}.' if licences else ''}{listed}"


def _record_set(root: Path, path: Path) -> dict[str, Any]:
    """The columns of a Parquet file."""
    name = path.relative_to(root).as_posix()
    record = name.removesuffix(".parquet").replace("/", "_")
    fields = [_field(record, name, column) for column in pq.read_schema(path)]
    return {"@type": "cr:RecordSet", "@id": record, "name": record, "field": fields}


def _field(record: str, file: str, column: pa.Field) -> dict[str, Any]:
    kind, lengths = column.type, []
    while pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind):
        lengths.append(str(kind.list_size) if pa.types.is_fixed_size_list(kind) else "-1")
        kind = kind.value_type
    described: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"{record}/{column.name}",
        "name": f"{record}/{column.name}",
        "dataType": _TYPES.get(str(kind), "sc:Text"),
        "source": {"fileObject": {"@id": file}, "extract": {"column": column.name}},
    }
    if (meaning := _meaning(file, column.name)) != "":
        described["description"] = meaning
    return described | ({"isArray": True, "arrayShape": ",".join(lengths)} if lengths else {})


def _meaning(file: str, column: str) -> str:
    fields = next((known.fields for known in STORE_FILES if known.path == file), ())
    return next((field.meaning for field in fields if field.name == column), "")
