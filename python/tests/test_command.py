"""The command line that the wheel brings along."""

import importlib.metadata
import json
import os
import signal
import subprocess
import sys
import sysconfig

import pytest

import lunarray

SCRIPT = os.path.join(sysconfig.get_path("scripts"), "lunarray")


def said(*words):
    return subprocess.run(words, capture_output=True, text=True)


@pytest.mark.parametrize("command", [[SCRIPT], [sys.executable, "-m", "lunarray"]])
def test_the_command_is_there_in_both_ways(command):
    told = said(*command, "--version")
    assert (told.returncode, told.stdout) == (0, f"lunarray {lunarray.__version__}\n")
    wrong = said(*command, "ran")
    assert wrong.returncode == 2 and "unrecognized subcommand 'ran'" in wrong.stderr
    failed = said(*command, "inspect", "nowhere.ccsds")
    assert failed.returncode == 1 and "error: " in failed.stderr and "nowhere.ccsds" in failed.stderr


def test_the_wheel_brings_licences_and_a_bill_of_materials():
    files = {file.name: file for file in importlib.metadata.files("lunarray")}
    assert "Permission is hereby granted" in files["LICENSE-MIT"].read_text()
    assert "Apache License" in files["LICENSE-APACHE"].read_text()
    bill = json.loads(files["lunarray-python.cyclonedx.json"].read_text())
    named = {part["name"] for part in bill["components"]}
    assert bill["bomFormat"] == "CycloneDX" and {"lunarray", "pyo3", "bincode", "faer"} <= named


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_ctrl_c_ends_a_command_with_its_code(tmp_path):
    # All windows of 1.3 years: many minutes.
    settings = ["--set", "products.pictures=false", "--set", "spacecraft.every_nth_window=1"]
    command = [SCRIPT, "run", "--out", str(tmp_path), *settings]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        # Lines of progress come once it has begun, and from then on signals end it in order.
        for line in process.stderr:
            if "windows" in line:
                break
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=300)
    assert process.returncode == 130
    assert (tmp_path / "summary.json").exists()


def test_the_stubs_name_what_is_there():
    import ast
    import pathlib

    import lunarray._native as native

    folder = pathlib.Path(lunarray.__file__).parent
    assert (folder / "py.typed").exists()
    stub = ast.parse((folder / "_native.pyi").read_text())
    named = {node.name: node for node in stub.body if isinstance(node, (ast.ClassDef, ast.FunctionDef))}
    there = {name for name in dir(native) if not name.startswith("_") and name != "VERSION"}
    assert set(named) == there
    for name, node in named.items():
        if isinstance(node, ast.ClassDef) and not node.bases:
            methods = {part.name for part in node.body if isinstance(part, ast.FunctionDef)} - {"__init__"}
            assert methods == {part for part in dir(getattr(native, name)) if not part.startswith("_")}, name
