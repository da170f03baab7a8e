"""Makes a release and checks it: `python tools/release.py`, in an environment with the extra `release`.

Checks the files for services by their schemas, builds the sdist, the pure wheel and the wheel with native code of this computer's kind
twice and compares them, has them checked by twine, installs the native wheel into an empty environment, assesses the sample flights there,
and writes the list of what was installed (SBOM, CycloneDX) and check sums. All goes to dist/. Nothing is uploaded.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# Schema that check-jsonschema has in itself: files.
SCHEMAS = {
    "github-actions": ("action.yml",),
    "github-workflows": tuple(str(path) for path in sorted((ROOT / ".github" / "workflows").glob("*.yml"))),
    "compose-spec": ("compose.yaml",),
    "citation-file-format": ("CITATION.cff",),
}


def main(argv: list[str] | None = None) -> int:
    """Every step; the exit code is 1 as soon as one fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder of the results")
    parser.add_argument("--no-isolation", action="store_true", help="build with the packages that are here, without a network")
    parser.add_argument("--pure", action="store_true", help="no wheel with native code")
    parser.add_argument("--no-install", action="store_true", help="neither install the wheel nor list what it brings")
    options = parser.parse_args(argv)
    os.environ.setdefault("SOURCE_DATE_EPOCH", _run("git", "log", "-1", "--format=%ct").strip())
    for schema, files in SCHEMAS.items():
        _run(sys.executable, "-m", "check_jsonschema", "--builtin-schema", f"vendor.{schema}", *files)
    _run("hadolint", str(ROOT / "Dockerfile"))
    _report("action, workflows, compose file, citation and Dockerfile are as their schemas and rules ask")
    with tempfile.TemporaryDirectory() as scratch:
        first, second = Path(scratch, "first"), Path(scratch, "second")
        for folder in (first, second):
            # What a cache holds from before, or of others, goes into no wheel.
            os.environ["ROTORWATCH_CACHE"] = str(folder.with_suffix(".cache"))
            build(folder, options.no_isolation, options.pure)
        sums = digests(first)
        if sums != digests(second):
            print(f"two builds differ: {sums} and {digests(second)}", file=sys.stderr)
            return 1
        _report(f"built twice, alike: {', '.join(sums)}")
        print(_run(sys.executable, "-m", "twine", "check", "--strict", *map(str, sorted(first.iterdir()))))
        native = [wheel for wheel in first.glob("*.whl") if "-any." not in wheel.name]
        if not options.no_install and native:
            try_wheel(native[0], Path(scratch, "environment"), first)
        options.out.mkdir(parents=True, exist_ok=True)
        for file in sorted(first.iterdir()):
            shutil.copy2(file, options.out)
    lines = [f"{digest}  {name}\n" for name, digest in digests(options.out).items() if name != "SHA256SUMS"]
    (options.out / "SHA256SUMS").write_text("".join(lines))
    print("".join(lines), end="")
    return 0


def build(folder: Path, no_isolation: bool = False, pure: bool = False) -> None:
    """sdist and pure wheel, made of the sdist, into the folder; then the wheel with native code, as a manylinux wheel."""
    words = [sys.executable, "-m", "build", *(["--no-isolation"] if no_isolation else [])]
    _run(*words, "--outdir", str(folder), str(ROOT), ROTORWATCH_SHIP="none")
    if pure:
        return
    made = folder / "native"
    _run(*words, "--wheel", "--outdir", str(made), str(ROOT), ROTORWATCH_SHIP="portable")
    (wheel,) = made.glob("*.whl")
    if "-any." in wheel.name:
        raise SystemExit("no native code was built: it needs a C compiler and JAX. --pure goes without.")
    _run(sys.executable, "-m", "auditwheel", "repair", "--wheel-dir", str(folder), str(wheel))
    shutil.rmtree(made)


def try_wheel(wheel: Path, environment: Path, out: Path) -> None:
    """Install the wheel into an empty environment, assess the sample flights with it, and write the SBOM of that environment to `out`."""
    venv.create(environment, with_pip=True)
    python = str(environment / "bin" / "python")
    _run(python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", str(wheel))
    _run(python, "-m", "pip", "check")
    output = _run(str(environment / "bin" / "rotorwatch"), "demo", cwd=environment)
    if "FAULT FOUND" not in output or "HEALTHY" not in output:
        raise SystemExit(f"the installed wheel does not assess the sample flights as it should:\n{output}")
    _report("installed into an empty environment; the sample flights are assessed")
    bom = out / f"{wheel.name.split('-')[0]}-{wheel.name.split('-')[1]}.cdx.json"
    words = ["environment", "--output-reproducible", "--output-format", "JSON", "--output-file", str(bom), python]
    _run(sys.executable, "-m", "cyclonedx_py", *words)
    found = json.loads(bom.read_text(encoding="utf-8"))
    for component in found["components"]:  # a path of this computer says nothing elsewhere
        component["externalReferences"] = [r for r in component.get("externalReferences", ()) if not r["url"].startswith("file:")]
    bom.write_text(json.dumps(found, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    _report(f"SBOM: {bom.name}, {len(found['components'])} packages")


def digests(folder: Path) -> dict[str, str]:
    """Name of each file -> SHA-256."""
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(folder.iterdir())}


def _run(*words: str, cwd: Path = ROOT, **environment: str) -> str:
    """What a command prints. Ends the program with its error output when it fails."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    clean |= environment
    clean["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{clean['PATH']}"
    done = subprocess.run(words, cwd=cwd, env=clean, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} failed:\n{done.stdout}\n{done.stderr}")
    return done.stdout


def _report(text: str) -> None:
    print(f"== {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
