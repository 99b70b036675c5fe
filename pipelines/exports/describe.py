"""The description of an export: croissant.json (Croissant 1.1 with responsible-AI terms) and a dataset card.

It is derived from the store's facts and has no date, so that equal stores give equal bytes.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from hoidata.dataset_folders import dataset_facts
from hoidata.files import sha256_file
from hoidata.store.fields import STORE_FILES, StoreFile
from hoidata.store.info import embedded_hand_warning
from hoidata.store.store import Store
from pipelines.exports.licences import OWN_USE, ArrayLicence, licences_of
from pipelines.exports.motion import Format, verbs_of, write_json

_MARKUP = re.compile(r"[\\`*_\[\]|~$]")
CROISSANT = "http://mlcommons.org/croissant/1.1"
RESPONSIBLE = "http://mlcommons.org/croissant/RAI/1.0"
HOMEPAGE = "https://schema.org/Dataset"  # for a dataset without a page, since Croissant requires an address
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


def selected(store: Store, clip_ids: Sequence[str]) -> Store:
    """The store as if it had only some of its clips."""
    rows = store.sequences.loc[list(clip_ids)]
    objects = set(rows["object"]).union(*rows["other_objects"])
    counts = {"clips": len(rows), "frames": int(rows["n_frames"].sum()), "objects": len(objects)}
    return replace(store, sequences=rows, info=store.info | {"counts": store.info["counts"] | counts}, _rows={})


def write_description(folder: Path, store: Store, form: Format, for_own_use: bool) -> None:
    """Write croissant.json and README.md about the files in ``folder``; for the format croissant, about the store."""
    root = store.folder if form.write is None else folder
    write_json(folder / "croissant.json", croissant(root, store, form, for_own_use))
    (folder / "README.md").write_text(dataset_card(root, store, form, for_own_use), encoding="utf-8")


def croissant(root: Path, store: Store, form: Format, for_own_use: bool) -> dict[str, Any]:
    """The description of the files below ``root`` as JSON-LD, with relative addresses."""
    info, name = store.info, _name(store)
    register, version = str(info.get("where_to_register", "")), str(info["dataset_version"]).split(".")
    files = [path for path in sorted(root.rglob("*")) if path.is_file() and not path.name.startswith(".")]
    array_licences = licences_of(info)
    values: dict[str, Any] = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [CROISSANT, RESPONSIBLE],
        "name": name,
        "description": f"{_summary(store)} {_sentence(form.meaning)}",
        "license": list(dict.fromkeys(map(_licence_address, array_licences))),
        "url": next((word.strip("(),;") for word in register.split() if word.startswith("https://")), HOMEPAGE),
        "version": ".".join([*version, "0", "0"][:3]) if all(map(str.isdigit, version)) else "0.0.0",
        "keywords": ["hand-object interaction", "motion", "MANO", str(info["dataset"])],
        "citeAs": _paper(info) or name,
        **{f"rai:{key}": value for key, value in _responsible(store, form).items()},
    }
    if for_own_use:
        values["usageInfo"] = OWN_USE
    values["distribution"] = [_file_object(root, path, array_licences) for path in files]
    meanings = {column.name: column.meaning for column in form.columns}
    values["recordSet"] = [_record_set(root, path, meanings) for path in files if path.suffix == ".parquet"]
    return values


def dataset_card(root: Path, store: Store, form: Format, for_own_use: bool) -> str:
    """README.md with front matter for Hugging Face (licence, files per subset), conventions and licence per array."""
    array_licences = licences_of(store.info)
    lines = [f"# {markdown_text(_name(store))}", "", markdown_text(_summary(store)), "", _sentence(form.meaning), ""]
    if for_own_use:
        lines += [f"**Exported {OWN_USE}.**", ""]
    lines += _conventions(store.info, form)
    lines += ["", "## Licence per array", "", "| arrays | content | SPDX | may be shared |", "|---|---|---|---|"]
    lines += [
        f"| {item.kind.name} | {item.kind.meaning} | {item.spdx} | {'yes' if item.may_be_shared else 'no'} |"
        for item in array_licences
    ]
    licence_words = {item.spdx: item.licence for item in array_licences}
    lines += ["", *(f"- {spdx}: {markdown_text(words)}" for spdx, words in licence_words.items())]
    lines += ["", "## Provenance", ""]
    for key, value in _responsible(store, form).items():
        lines.append(f"- {key}: {markdown_text('; '.join(value) if isinstance(value, list) else value)}")
    return f"---\n{_front_matter(root, store, array_licences)}---\n\n" + "\n".join(lines) + "\n"


def _front_matter(root: Path, store: Store, array_licences: tuple[ArrayLicence, ...]) -> str:
    spdx = array_licences[0].spdx
    licence = {"CC0-1.0": "cc0-1.0"}.get(spdx, spdx.lower() if spdx.startswith("CC-") else "other")
    facts: dict[str, Any] = {"pretty_name": _name(store), "license": licence}
    facts |= {"license_name": spdx.lower()} if licence == "other" else {}
    facts["tags"] = ["hand-object-interaction", "robotics", "3d"]
    if data := sorted((root / "data").glob("*.parquet")):
        files = [{"split": path.stem, "path": f"data/{path.name}"} for path in data]
        facts["configs"] = [{"config_name": "default", "data_files": files}]
    return yaml.safe_dump(facts, sort_keys=False, allow_unicode=True)


def _conventions(info: dict[str, Any], form: Format) -> list[str]:
    """Markdown lines about frame, units, hand model, and the meaning of each array."""
    frame, hand = info["frame"], info["hand_model"]
    up = f"its up axis is {frame['up_axis']}" if frame["up_axis"] else "its up axis is not stated"
    lines = [
        "## Conventions",
        "",
        f"- Units: metre, radian, second; {info['fps']} frames per second; column vectors; right-handed.",
        f"- World frame: {form.world}. The source's: {markdown_text(frame['note'])}; {up}; gravity {frame['gravity']}.",
        f"- Hand model: {markdown_text(hand['name'])}, SHA-256 {markdown_text(hand['digest'])}. Hand parameters are "
        "relative to it: angles to its flat hand, shape to its template unless a personal rest mesh is given. "
        "The wrist joint is joint 0; it is not MANO's transl.",
        f"- Frames in which a hand is not tracked are marked; {form.untracked}.",
    ]
    if stand_in := embedded_hand_warning(info):
        lines.append(f"- Warning: {markdown_text(stand_in)}.")
    if form.columns:
        lines += ["", "| array | type | shape | meaning |", "|---|---|---|---|"]
        lines += [f"| {c.name} | {c.dtype} | {list(c.shape) or ''} | {c.meaning} |" for c in form.columns]
    return lines


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _responsible(store: Store, form: Format) -> dict[str, Any]:
    """The responsible-AI terms of Croissant that the facts of a store provide."""
    info, counts, rows = store.info, store.info["counts"], store.sequences
    errors_m = rows["fit_error_m"].dropna().tolist()  # of hands fitted to keypoints
    verbs = Counter(verb for clip_id, verb in verbs_of(store).items() if clip_id in rows.index)
    verbs_by_count = sorted(verbs.items(), key=lambda pair: (-pair[1], str(pair[0])))
    limits = [f"gravity: {info['frame']['gravity']}"]
    if errors_m:
        error_mm = 1000 * sum(errors_m) / len(errors_m)
        limits.append(f"hands of {len(errors_m)} clips are fitted to keypoints, mean error {error_mm:.1f} mm")
    origin = "Generated by code in the raw format of" if info["synthetic"] else "Recorded by the authors of"
    return {
        "dataCollection": f"{origin} {_paper(info) or info['dataset']}; {counts['files']} raw files",
        "dataCollectionType": ["Synthetic data"] if info["synthetic"] else ["Physical data collection"],
        "dataCollectionRawData": str(info.get("where_to_register", "see dataCollection")),
        "dataCollectionMissingData": (
            f"{counts['quarantined']} sequences or intervals are excluded, with reasons in quarantine.parquet; "
            f"frames in which a hand is not tracked are marked; {form.untracked}"
        ),
        "dataPreprocessingProtocol": [
            f"resampled from {info['source_fps']:g} to {info['fps']} frames per second, metres, right-handed world",
            f"hands: {info['hand_convention']['note']}; stored with absolute angles, hand model "
            f"{info['hand_model']['name']}",
        ],
        "dataAnnotationProtocol": (
            "verbs and objects as labelled by the source, verbs without a label derived from motion; sentences from "
            "rules applied to them"
        ),
        "dataBiases": [
            f"{rows['subject'].nunique()} subjects, {counts['objects']} objects, {len(verbs)} verbs; most frequent: "
            + ", ".join(f"{verb} ({count})" for verb, count in verbs_by_count[:3])
        ],
        "dataLimitations": limits,
        "dataUseCases": ["training and evaluation of models of hand-object motion"],
        "personalSensitiveInformation": (
            ["none: no person was recorded"] if info["synthetic"] else
            ["motion and shape of hands of persons known by the source's ids"]
        ),
    }  # fmt: skip


def _paper(info: dict[str, Any]) -> str:
    facts = dataset_facts(str(info["dataset"]))
    return facts.paper if facts else ""


def _name(store: Store) -> str:
    return f"hoidata-{store.info['dataset']}{'-synthetic' if store.info['synthetic'] else ''}"


def _summary(store: Store) -> str:
    info, counts = store.info, store.info["counts"]
    kind = "Synthetic hand-object interaction" if info["synthetic"] else "Hand-object interaction"
    return (
        f"{kind} in the conventions of {info['dataset']}: {counts['clips']} clips, {counts['frames']} frames, "
        f"{counts['objects']} objects."
    )


def _licence_address(item: ArrayLicence) -> str:
    return item.licence if item.spdx.startswith("LicenseRef") else f"https://spdx.org/licenses/{item.spdx}.html"


def _file_object(root: Path, path: Path, array_licences: tuple[ArrayLicence, ...]) -> dict[str, Any]:
    name = path.relative_to(root).as_posix()
    values: dict[str, Any] = {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "contentUrl": name,
        "contentSize": f"{path.stat().st_size} B",
        "encodingFormat": _ENCODINGS.get(path.suffix, "application/octet-stream"),
        "sha256": sha256_file(path),
    }
    if file := next((file for file in STORE_FILES if fnmatch(name, file.path)), None):
        values["description"] = _about(file, array_licences)
    return values


def _about(file: StoreFile, array_licences: tuple[ArrayLicence, ...]) -> str:
    """Meaning and licence of a file of a store, and for an NPZ file of its arrays."""
    licences = ", ".join(dict.fromkeys(item.spdx for item in array_licences if file.path in item.kind.arrays))
    arrays = [f"{f.name} {f.dtype}: {f.meaning}{f', {f.unit}' if f.unit else ''}" for f in file.fields]
    listed = f" Arrays: {'; '.join(arrays)}." if file.path.endswith(".npz") else ""
    return f"{file.meaning}.{f' Licence: {licences}.' if licences else ''}{listed}"


def _record_set(root: Path, path: Path, meanings: dict[str, str]) -> dict[str, Any]:
    """The columns of a Parquet file, with ``meanings`` by name; for a file of a store, those of its schema."""
    name = path.relative_to(root).as_posix()
    record = name.removesuffix(".parquet").replace("/", "_")
    if file := next((file for file in STORE_FILES if file.path == name), None):
        meanings = {field.name: field.meaning for field in file.fields}
    fields = [_field(record, name, column, meanings.get(column.name, "")) for column in pq.read_schema(path)]
    return {"@type": "cr:RecordSet", "@id": record, "name": record, "field": fields}


def _field(record: str, file: str, column: pa.Field, meaning: str) -> dict[str, Any]:
    dtype, lengths = column.type, []
    while pa.types.is_list(dtype) or pa.types.is_fixed_size_list(dtype):
        lengths.append(str(dtype.list_size) if pa.types.is_fixed_size_list(dtype) else "-1")
        dtype = dtype.value_type
    values: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"{record}/{column.name}",
        "name": f"{record}/{column.name}",
        "dataType": _TYPES.get(str(dtype), "sc:Text"),
        "source": {"fileObject": {"@id": file}, "extract": {"column": column.name}},
    }
    if meaning:
        values["description"] = meaning
    return values | ({"isArray": True, "arrayShape": ",".join(lengths)} if lengths else {})


def markdown_text(text: Any) -> str:
    """Text as plain text in Markdown: on one line, with markup, HTML and table borders escaped."""
    return _MARKUP.sub(r"\\\g<0>", " ".join(str(text).split())).replace("&", "&amp;").replace("<", "&lt;")
