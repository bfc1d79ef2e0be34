"""A patched URDF that holds an older arm in comments: they are no part of the arm."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

from benchmarks.patch.arms import UR_JOINTS, urdf
from gapbridge.bridge.patch import PatchOptions, changes_of, format_of
from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.model import Model

ARM = builtin_arm("ur10e")
CHANGES = (
    Term("joint_offset", Site(3), (0.004,)),
    Term("coulomb_friction", Site(2), (4.0,)),
    Term("link_inertia", Site(3), (0.1,)),
    Term("link_cog", Site(2), (0.4, -0.2, 0.1)),
)


def patched(path: Path, text: str) -> str:
    path.write_text(text, encoding="utf-8")
    model = Model(ARM).with_terms(CHANGES)
    return format_of(path).patch(path, changes_of(model), PatchOptions(), []).text


def elements(text: str) -> str:
    """Return the canonical form of an arm, without comments and spaces between elements."""
    return ElementTree.canonicalize(text, strip_text=True)


def test_joints_and_links_in_comments_are_left_as_they_are(tmp_path: Path) -> None:
    given = re.sub(r"\s*<!--.*?-->", "", urdf(ARM, UR_JOINTS))
    older = "".join(f"<!-- {part} -->\n" for part in re.findall(
        r"<joint name=[^>]*type.*?</joint>|<link name=[^>]*[^/]>.*?</link>", given, re.DOTALL
    ))  # fmt: skip
    assert older.count("<!--") == 2 * ARM.n + 1
    begin = '<robot name="arm">'
    given = given.replace("</joint>", "<!-- </joint> --></joint>")
    commented = f"<!-- {begin} -->\n{given.replace(begin, begin + older)}"
    text = patched(tmp_path / "commented.urdf", commented)
    assert older in text
    assert elements(text) == elements(patched(tmp_path / "plain.urdf", given))
    assert elements(text) != elements(given)


def test_meshes_beside_a_urdf_are_found_from_another_folder(tmp_path: Path) -> None:
    (tmp_path / "model" / "meshes").mkdir(parents=True)
    (tmp_path / "model" / "meshes" / "a & b.stl").touch()
    names = ("meshes/a &amp; b.stl", "package://arm/a.stl", "meshes/missing.stl")
    visuals = "".join(
        f'<visual><geometry><mesh scale="1 1 1" filename="{name}"/></geometry></visual>'
        for name in names
    )
    given = urdf(ARM, UR_JOINTS).replace("</link>", f"{visuals}<!-- {visuals} --></link>", 1)
    path = tmp_path / "model" / "a.urdf"
    path.write_text(given, encoding="utf-8")
    options = PatchOptions(folder=tmp_path / "out")
    text = format_of(path).patch(path, changes_of(Model(ARM).with_terms(CHANGES)), options, []).text
    found = [mesh.get("filename") for mesh in ElementTree.fromstring(text).iter("mesh")]
    assert found == ["../model/meshes/a & b.stl", *names[1:]]
    assert visuals in text  # the comment


def test_names_with_an_ampersand_are_found(tmp_path: Path) -> None:
    given = urdf(ARM, UR_JOINTS).replace(UR_JOINTS[2], "elbow &amp; forearm")
    path = tmp_path / "a.urdf"
    path.write_text(given.replace("link_3", "link &lt;3&gt;"), encoding="utf-8")
    joints = tuple(name if i != 2 else "elbow & forearm" for i, name in enumerate(UR_JOINTS))
    changes = changes_of(Model(ARM).with_terms(CHANGES))
    text = format_of(path).patch(path, changes, PatchOptions(joints=joints), []).text
    before, after = (ElementTree.fromstring(t) for t in (path.read_text("utf-8"), text))
    masses = [[float(m.get("value", "")) for m in t.iter("mass")] for t in (before, after)]
    ratios = [new / old for old, new in zip(*masses, strict=True)]
    assert [round(ratio, 6) for ratio in ratios] == [1, 1, 1.1, 1, 1, 1]
