"""Mutation tests with mutmut: ``python -m tests.mutation hoidata/contact --sample 60`` (``make mutation``).

mutmut changes one expression of a function at a time in a copy of the tree (``mutants/``) and runs those tests of the
package that call this function. A change that no test detects has survived. Decorated functions, such as the compiled
kernels, are not changed.
"""

import argparse
import random
import sys
from collections import Counter
from pathlib import Path

from mutmut import __main__ as mutmut
from mutmut.configuration import config
from mutmut.mutation.file_mutation import mutate_file_contents
from mutmut.stats import status_by_exit_code
from mutmut.utils.format_utils import get_mutant_name


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__.splitlines()[0])
    parser.add_argument("paths", nargs="+", help="packages, such as hoidata/contact")
    parser.add_argument("--sample", type=int, default=60, help="mutants of each package")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    config().only_mutate = [f"{path}/*" for path in arguments.paths]
    config().pytest_add_cli_args_test_selection = [f"tests/{path}" for path in arguments.paths]
    names = [name for path in arguments.paths for name in _sampled(path, arguments.sample, arguments.seed)]
    mutmut._run(names, arguments.jobs)
    tried = mutmut.collect_source_file_mutation_data(mutant_names=names)[0]
    results = [(name, status_by_exit_code[data.exit_code_by_key[name]]) for data, name, _ in tried]
    for name, status in sorted(results):
        if status != "killed":
            print(f"{status}: mutmut show {name}")
    for path in arguments.paths:
        counts = Counter(status for name, status in results if name.startswith(path.replace("/", ".") + "."))
        print(f"{path}: {dict(counts)}, seed {arguments.seed}")
    return int(any(status == "survived" for _, status in results))


def _sampled(path: str, count: int, seed: int) -> list[str]:
    """The names of at most ``count`` mutants of a package, in the order of the files."""
    files = sorted(Path(path).rglob("*.py"))
    changed = {file: mutate_file_contents(str(file), file.read_text()).mutant_names for file in files}
    names = [get_mutant_name(file, name) for file in files for name in changed[file]]
    chosen = random.Random(seed).sample(range(len(names)), min(count, len(names)))
    print(f"{path}: {len(chosen)} of {len(names)} mutants")
    return [names[number] for number in sorted(chosen)]


if __name__ == "__main__":
    sys.exit(main())
