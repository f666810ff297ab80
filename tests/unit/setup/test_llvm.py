"""Discovery of LLVM, the saved choice, and the bookkeeping of the set-up. Nothing here needs a network."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from psdr_jit.cli import setup_env
from psdr_jit.errors import SetupError
from psdr_jit.setup import llvm, llvm_fetch, private_apt, system_advice

KEY = "psdr 1 1234 567 /somewhere/my clone"


@pytest.fixture(autouse=True)
def own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Each test has its own state folder and no library named in the environment."""
    monkeypatch.setattr(llvm_fetch, "state_folder", lambda: tmp_path / "state")
    monkeypatch.setattr(llvm, "drjit_version", lambda: "1.5.0")
    monkeypatch.setenv(llvm.VARIABLE, "")  # restored afterwards, even if the code under test sets it
    monkeypatch.delenv(llvm.VARIABLE)
    return tmp_path / "state"


@pytest.fixture
def choice(tmp_path: Path) -> llvm.Choice:
    """A choice whose library exists (as an empty file)."""
    library = tmp_path / "libLLVM.so.19.1"
    library.touch()
    return llvm.Choice(str(library), "19.1.7", library.stat().st_mtime, "1.5.0", ())


@pytest.mark.parametrize(
    ("path", "major"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", 14),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib64/libLLVM.so.20.1", 20),
        ("/usr/lib/llvm-18/lib/libLLVM.so.1", 18),
        ("/opt/llvm-3/.venv/llvm/libllvm17t64/libLLVM.so.1", 17),
        ("/opt/homebrew/Cellar/llvm@18/18.1.8/lib/libLLVM.dylib", 18),
        ("/opt/homebrew/Cellar/llvm/21.1.0/lib/libLLVM.dylib", 21),
        ("/usr/local/lib/libLLVM.so", 0),
    ],
)
def test_major_version(path: str, major: int) -> None:
    assert llvm.major_version(path) == major


def test_candidates_are_newest_first_and_unique(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("libLLVM-9.so.1", "libLLVM-15.so.1", "libLLVM.so.19.1"):
        (tmp_path / name).touch()
    (tmp_path / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    monkeypatch.setattr(llvm, "PATTERNS", (f"{tmp_path}/libLLVM*.so*",))
    found = [Path(path).name for path in llvm.candidates() if path.startswith(os.path.realpath(tmp_path))]
    assert found == ["libLLVM.so.19.1", "libLLVM-15.so.1", "libLLVM-9.so.1"]


def test_first_candidate_that_passes_is_taken(monkeypatch: pytest.MonkeyPatch, choice: llvm.Choice) -> None:
    """The newest one fails its probe, one is too old to be tried."""
    asked = []

    def probe(path: str) -> llvm.Verdict:
        asked.append(path)
        return llvm.Verdict(path, choice if "16" in path else None, "reason")

    monkeypatch.setattr(llvm, "candidates", lambda: ["/libLLVM-22.so", "/libLLVM-16.so", "/libLLVM-14.so"])
    monkeypatch.setattr(llvm, "probe", probe)
    assert llvm.try_candidates()[0] is choice
    assert asked == ["/libLLVM-22.so", "/libLLVM-16.so"]
    monkeypatch.setattr(llvm, "candidates", lambda: ["/libLLVM-22.so", "/libLLVM-14.so"])
    none, verdicts = llvm.try_candidates()
    assert none is None and len(verdicts) == 2 and "too old" in verdicts[1].reason


def test_saved_choice_is_applied(choice: llvm.Choice) -> None:
    assert llvm.apply_saved_choice() is None
    llvm.save_choice(choice)
    assert llvm.read_choice() == choice
    assert llvm.apply_saved_choice() == choice
    assert os.environ[llvm.VARIABLE] == choice.path
    assert llvm.user_path() is None, "a path that we set must not be taken for the user's"


def test_user_path_is_respected(choice: llvm.Choice, monkeypatch: pytest.MonkeyPatch) -> None:
    llvm.save_choice(choice)
    monkeypatch.setenv(llvm.VARIABLE, "/mine/libLLVM.so")
    monkeypatch.setattr(llvm, "probe", lambda path: llvm.Verdict(path, None, "is broken"))
    assert llvm.apply_saved_choice() is None
    assert os.environ[llvm.VARIABLE] == "/mine/libLLVM.so"
    with pytest.raises(SetupError, match="/mine/libLLVM.so does not work: is broken"):
        llvm.ensure_llvm()


def test_saved_choice_with_a_lost_dependency_is_not_applied(choice: llvm.Choice) -> None:
    llvm.save_choice(llvm.Choice(choice.path, choice.version, choice.mtime, "1.5.0", ("/gone/libz3.so.4",)))
    assert llvm.apply_saved_choice() is None
    assert llvm.VARIABLE not in os.environ


@pytest.mark.parametrize("text", ["", "{", "[]", '{"path": "x"}', '{"preload": [], "unknown": 1}'])
def test_damaged_choice_counts_as_none(own_state: Path, text: str) -> None:
    own_state.mkdir()
    (own_state / llvm.CHOICE_FILE).write_text(text)
    assert llvm.read_choice() is None


def test_choice_gets_stale(choice: llvm.Choice, monkeypatch: pytest.MonkeyPatch) -> None:
    assert llvm.is_fresh(choice)
    os.utime(choice.path, (1, 1))
    assert not llvm.is_fresh(choice)
    os.utime(choice.path, (choice.mtime, choice.mtime))
    assert llvm.is_fresh(choice)
    monkeypatch.setattr(llvm, "drjit_version", lambda: "1.6.0")
    assert not llvm.is_fresh(choice)


def test_without_llvm_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(llvm, "candidates", lambda: ["/usr/lib/libLLVM-14.so"])
    with pytest.raises(SetupError) as caught:
        llvm.ensure_llvm(fetch=False)
    message = str(caught.value)
    assert "/usr/lib/libLLVM-14.so: too old" in message
    assert "install one:" in message and llvm.VARIABLE in message


def test_fresh_choice_is_not_probed_again(choice: llvm.Choice, monkeypatch: pytest.MonkeyPatch) -> None:
    llvm.save_choice(choice)

    def probe(path: str) -> llvm.Verdict:
        raise AssertionError("the cached verdict must do")

    monkeypatch.setattr(llvm, "probe", probe)
    assert llvm.ensure_llvm() == choice


def test_probe_of_something_else(tmp_path: Path) -> None:
    """A file that is no library is turned down with the loader's reason, not with an exception."""
    fake = tmp_path / "libLLVM-99.so"
    fake.write_text("not a library")
    verdict = llvm.probe(str(fake))
    assert verdict.choice is None and "libLLVM-99.so" in verdict.reason


def test_reason_of_an_abort() -> None:
    stderr = "noise\nLLVM ERROR: Cannot select: 0x55d0: f32 = fminimum 0x1, 0x2\nIn function: f\n"
    assert (
        llvm.failure_reason(-6, stderr)
        == "aborts while compiling (LLVM ERROR: Cannot select: f32 = fminimum)"
    )
    assert llvm.failure_reason(1, "") == "no message"


def test_packages_newest_first() -> None:
    packages = ["libllvm9", "libllvm22", "libllvm17t64", "libllvm14", "libllvm15"]
    assert llvm_fetch.newest_first(packages) == ["libllvm22", "libllvm17t64", "libllvm15"]


def test_dependencies_leave_out_the_base_system(monkeypatch: pytest.MonkeyPatch) -> None:
    text = (
        "libllvm19\n  Depends: libc6\n |Depends: libz3-4\nlibc6\nlibstdc++6\nlibz3-4\n<libfoo>\nlibbar:i386\n"
    )
    text += "gcc-12-base\nzlib1g\nlibgcc-s1\n"
    monkeypatch.setattr(private_apt, "run_tool", lambda command: text)
    assert private_apt.with_dependencies(Path("c"), "libllvm19") == ["libllvm19", "libz3-4", "zlib1g"]


def test_collected_libraries_keep_their_links(tmp_path: Path) -> None:
    folder = tmp_path / "tree/usr/lib/x86_64-linux-gnu"
    folder.mkdir(parents=True)
    (folder / "libedit.so.2.0").write_text("x")
    (folder / "libedit.so.2").symlink_to("libedit.so.2.0")
    (folder / "README").touch()
    elsewhere = tmp_path / "tree/usr/lib/llvm-19/lib"
    elsewhere.mkdir(parents=True)
    (elsewhere / "libLLVM.so.1").symlink_to("../../x86_64-linux-gnu/libLLVM.so.19.1")
    collected = private_apt.collect_libraries(tmp_path / "tree", tmp_path / "flat")
    assert sorted(path.name for path in collected.iterdir()) == ["libedit.so.2", "libedit.so.2.0"]
    assert (collected / "libedit.so.2").read_text() == "x"


@pytest.mark.parametrize("family", ["debian", "fedora", "suse", "arch", "macos", "windows", "other"])
@pytest.mark.parametrize("piece", sorted(system_advice.COMMANDS))
def test_every_system_has_advice(family: str, piece: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(system_advice, "family", lambda: family)
    command = system_advice.install_command(piece)
    assert command and "{" not in command


@pytest.fixture
def environment(tmp_path: Path) -> Path:
    """The skeleton of an environment."""
    venv = tmp_path / "venv"
    (venv / "bin").mkdir(parents=True)
    (venv / "bin/python").touch()
    (venv / "bin/python").chmod(0o755)
    return venv


def test_stamp(environment: Path) -> None:
    """Complete for this key only, and not without an interpreter."""
    assert not setup_env.is_complete(environment, setup_env.STAMP, KEY)
    setup_env.write_stamp(environment, setup_env.STAMP, KEY)
    assert setup_env.is_complete(environment, setup_env.STAMP, KEY)
    assert not setup_env.is_complete(environment, setup_env.STAMP, KEY.replace("clone", "moved"))
    (environment / "bin/python").unlink()
    assert not setup_env.is_complete(environment, setup_env.STAMP, KEY)


def test_only_project_changed(environment: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(setup_env, "has_pip", lambda python: True)
    assert not setup_env.only_project_changed(environment, KEY)
    setup_env.write_stamp(environment, setup_env.PACKAGES, KEY)
    assert setup_env.only_project_changed(environment, KEY.replace("1234", "9999"))
    assert not setup_env.only_project_changed(environment, KEY.replace("clone", "moved"))


def test_foreign_environment_is_not_wiped(environment: Path) -> None:
    (environment / "pyvenv.cfg").touch()
    (environment / "precious").touch()
    with pytest.raises(setup_env.SetupFailure, match="not made by psdr"):
        setup_env.make_environment(environment)
    assert (environment / "precious").exists()


def test_startup_hook_names_the_library(
    tmp_path: Path, choice: llvm.Choice, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The generated module sets the variable, but neither over the user's nor for a library that is gone."""
    monkeypatch.setattr("sysconfig.get_path", lambda name: str(tmp_path))
    llvm.write_startup_hook(choice)
    source = (tmp_path / f"{llvm.HOOK_MODULE}.py").read_text()
    monkeypatch.setenv(llvm.VARIABLE, "/mine")
    exec(source, {})
    assert os.environ[llvm.VARIABLE] == "/mine"
    monkeypatch.delenv(llvm.VARIABLE)
    exec(source, {})
    assert os.environ[llvm.VARIABLE] == choice.path
    monkeypatch.delenv(llvm.VARIABLE)
    Path(choice.path).unlink()
    exec(source, {})
    assert llvm.VARIABLE not in os.environ


def test_saved_file_is_plain_json(own_state: Path, choice: llvm.Choice) -> None:
    llvm.save_choice(choice)
    assert json.loads((own_state / llvm.CHOICE_FILE).read_text())["version"] == "19.1.7"
    assert [path.name for path in own_state.iterdir()] == [llvm.CHOICE_FILE], "no temporary file left"
