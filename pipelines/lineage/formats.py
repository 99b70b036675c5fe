"""Output formats of a lineage: HTML page, Mermaid and PROV-JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from pipelines.lineage.digests import value_digest
from pipelines.lineage.raw import RawSource
from pipelines.lineage.tree import STATUSES, Node, overall_status

QUIET = ("same", "recorded")
PRODUCER = "urn:hoidata:lineage"
_STATUS_COLOURS = {"same": "#e5f5e5", "recorded": "#eeeeee", "uncommitted": "#fff4cc", "changed": "#fff4cc"}
_BAD_COLOUR = "#fadbd8"


@dataclass(frozen=True)
class Step:
    """One run of a stage."""

    name: str
    params: dict[str, Any]
    code_digest: str
    inputs: dict[str, str]  # path: algorithm and digest
    outputs: dict[str, str]  # path: algorithm and digest


def steps(tree: Node, record: dict[str, Any]) -> list[Step]:
    """The stage runs of a lineage, latest first; for a motion, the run that generated it."""
    if tree.kind == "motion":
        inputs = {child.name: child.digest for child in tree.children}
        return [Step("generate", params={}, code_digest="", inputs=inputs, outputs={tree.name: tree.digest})]
    last = record["stage"]
    algorithm = "md5" if record.get("schema", "").startswith("hoidata.lock") else "sha256"
    runs = []
    for name in _latest_first(record):
        stage = record["stages"][name]
        outputs = {tree.name: tree.digest} if name == last else _with(algorithm, stage.get("outputs", {}))
        runs.append(
            Step(name, stage["params"], value_digest(stage["code"]), _with(algorithm, stage["inputs"]), outputs)
        )
    return runs


def _latest_first(record: dict[str, Any]) -> list[str]:
    """The stages in reverse topological order: each before its inputs."""
    stages = record["stages"]
    made_by = {path: name for name, stage in stages.items() for path in stage.get("outputs", ())}
    done: dict[str, None] = {}

    def visit(name: str) -> None:
        for path in stages[name]["inputs"]:
            if path in made_by and made_by[path] not in done:
                visit(made_by[path])
        done[name] = None

    visit(record["stage"])
    return list(reversed(done))


def _with(algorithm: str, digests: dict[str, str | None]) -> dict[str, str]:
    return {path: f"{algorithm} {digest}" if digest else "" for path, digest in digests.items()}


def mermaid(tree: Node, record: dict[str, Any]) -> str:
    """A flowchart: stages as boxes, files as rounded boxes, coloured by status."""
    names: dict[str, str] = {}
    status = {node.name: node.status for node in tree.walk() if not node.repeated}
    boxes, arrows = [], []

    def box(name: str, shape: tuple[str, str]) -> str:
        if name not in names:
            names[name] = f"n{len(names)}"
            boxes.append(f'    {names[name]}{shape[0]}"{_mermaid_text(name)}"{shape[1]}')
            colour = _STATUS_COLOURS.get(status.get(name, "same"), _BAD_COLOUR)
            boxes.append(f"    style {names[name]} fill:{colour}")
        return names[name]

    for step in steps(tree, record):
        stage = box(step.name, ("[", "]"))
        arrows += [f"    {box(path, ('(', ')'))} --> {stage}" for path in step.inputs]
        arrows += [f"    {stage} --> {box(path, ('(', ')'))}" for path in step.outputs]
    return "\n".join(["flowchart LR", *boxes, *dict.fromkeys(arrows)]) + "\n"


def _mermaid_text(text: str) -> str:
    """Text for a quoted label; special characters become character codes."""
    return "".join(char if char.isalnum() or char in "/._-@: " else f"#{ord(char)};" for char in text)


def prov(tree: Node, record: dict[str, Any]) -> dict[str, Any]:
    """PROV-JSON: files and code are entities, runs are activities, hoidata is the agent."""
    document: dict[str, Any] = {
        "prefix": {"hoi": f"{PRODUCER}:", "prov": "http://www.w3.org/ns/prov#"},
        "entity": {},
        "activity": {},
        "agent": {"hoi:hoidata": {"prov:type": {"$": "prov:SoftwareAgent", "type": "prov:QUALIFIED_NAME"}}},
        "used": {},
        "wasGeneratedBy": {},
        "wasAssociatedWith": {},
    }
    for step in steps(tree, record):
        activity = _qualified("run", step.name)
        document["activity"][activity] = {f"hoi:{key}": str(value) for key, value in step.params.items()}
        code = {_qualified("code", step.code_digest): ""} if step.code_digest else {}
        used = {_qualified("file", path): digest for path, digest in step.inputs.items()} | code
        generated = {_qualified("file", path): digest for path, digest in step.outputs.items()}
        digests = (used | generated).items()
        document["entity"] |= {name: {"hoi:digest": digest} if digest else {} for name, digest in digests}
        for relation, entities in (("used", used), ("wasGeneratedBy", generated)):
            for name in entities:
                link = f"_:{relation}{len(document[relation])}"
                document[relation][link] = {"prov:activity": activity, "prov:entity": name}
        association = {"prov:activity": activity, "prov:agent": "hoi:hoidata"}
        document["wasAssociatedWith"][f"_:by{len(document['activity'])}"] = association
    return document


def _qualified(kind: str, name: str) -> str:
    return f"hoi:{kind}/{quote(name, safe='/@')}"


def write_lineage_page(path: Path, tree: Node, record: dict[str, Any], sources: Sequence[RawSource]) -> Path:
    """Write the lineage tree as one HTML file. Nodes whose files changed since the checkpoint are expanded."""
    from pipelines.pages.player import write_page  # imports the motion player

    status = overall_status(tree)
    stages = dict.fromkeys(node.name for node in tree.walk() if node.kind == "stage")
    return write_page(
        path,
        "lineage.html",
        title=f"Lineage of {tree.name}",
        status=status,
        meaning=STATUSES[status],
        tree=tree,
        loud={node.name for node in tree.walk() if any(below.status not in QUIET for below in node.walk())},
        anchors={name: f"stage-{number}" for number, name in enumerate(stages)},
        libraries=record.get("libraries", {}),
        sources=list(sources),
        has_players=False,
    )
