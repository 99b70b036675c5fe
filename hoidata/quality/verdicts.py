"""What quality control says of clips, read back from the folder its stage writes."""

from pathlib import Path

from hoidata.files.written import read_table, require_output


def left_out_reasons(folder: str | Path) -> dict[str, str]:
    """Why each clip that failed is left out, by clip id. Raises MissingResource where no stage has written."""
    require_output(folder, "quality", "clips.parquet")
    rows = read_table(Path(folder) / "clips.parquet", ["clip_id", "verdict", "reasons"])
    failed = rows[rows["verdict"] == "left out"]
    return {
        clip_id: f"left out by quality control: {reasons}"
        for clip_id, reasons in zip(failed["clip_id"].tolist(), failed["reasons"].tolist(), strict=True)
    }
