"""Whatever is wrong with a log's files: one sentence, never a traceback, never half the messages in silence."""

import os
import stat

import numpy as np
import pytest
from log_samples import KINDS, T0, some_keyframes, write_mcap, write_plain_mcap, write_rosbag2
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from message_samples import a_keyframe, assert_same_keyframe
from rosbags.rosbag2 import StoragePlugin

from xalign_ros.core.errors import LogError
from xalign_ros.io.log import Log
from xalign_ros.io.messages import KEYFRAME

LFS = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a214614ab2935c943f9e0ff69d22e\nsize 12345\n"


def read(path):
    with Log(path) as log:
        return [keyframe.id for _, keyframe, _ in log.keyframes()]


def assert_one_sentence(error, path):
    text = str(error.value)
    assert text.count("\n") == 0
    assert str(path) in text
    assert len(text) < 400 + len(str(path))


def folder_without_metadata(path):
    write_rosbag2(path, some_keyframes(1))
    (path / "metadata.yaml").unlink()


def folder_with(name, change):
    def make(path):
        write_rosbag2(path, some_keyframes(2))
        target = path / name
        target.write_bytes(change(target.read_bytes()))

    return make


def folder_with_cut_mcap(path):
    """Twelve chunks of two keyframes each, of which the last three are gone."""
    write_rosbag2(path, some_keyframes(24), StoragePlugin.MCAP, topic="keyframes")
    part = path / f"{path.name}.mcap"
    write_plain_mcap(part, some_keyframes(24), chunk_size=2000)
    part.write_bytes(part.read_bytes()[: chunks_of(part)[-3] + 50])


def folder_without_its_file(path):
    write_rosbag2(path, some_keyframes(1))
    (path / f"{path.name}.db3").unlink()


def database_with_pending_log(path):
    write_rosbag2(path.with_name("made"), some_keyframes(1))
    path.write_bytes((path.with_name("made") / "made.db3").read_bytes())
    path.with_name(f"{path.name}-wal").write_bytes(b"x" * 100)


def with_summary_changed(path):
    whole = bytearray(write_mcap(path, some_keyframes(2)).read_bytes())
    k = whole.rfind(b"xalign_msgs/msg/Keyframe")
    whole[k] ^= 1
    path.write_bytes(whole)


def foreign_encoding(path):
    writer = Writer(str(path))
    writer.start(profile="ros1")
    schema = writer.register_schema(KEYFRAME, "ros1msg", b"uint64 id")
    channel = writer.register_channel("keyframes", "ros1", schema)
    writer.add_message(channel, T0, b"12345678", T0)
    writer.finish()


def chunks_of(path):
    """Where each chunk of an MCAP file begins."""
    with path.open("rb") as file:
        return [chunk.chunk_start_offset for chunk in make_reader(file).get_summary().chunk_indexes]


BAD = {
    "missing.mcap": (lambda path: None, "there is no log"),
    "empty.mcap": (lambda path: path.write_bytes(b""), "is empty"),
    "empty.bag": (lambda path: path.write_bytes(b""), "is empty"),
    "empty.db3": (lambda path: path.write_bytes(b""), "is empty"),
    "pointer.mcap": (lambda path: path.write_text(LFS), "git lfs pull"),
    "pointer.bag": (lambda path: path.write_text(LFS), "git lfs pull"),
    "text.mcap": (lambda path: path.write_text("some notes\n" * 50), "is no log: neither MCAP"),
    "text.txt": (lambda path: path.write_text("short"), "is no log: neither MCAP"),
    "zeros.mcap": (lambda path: path.write_bytes(bytes(5000)), "is no log: neither MCAP"),
    "old.bag": (lambda path: path.write_bytes(b"#ROSBAG V1.2\n" + bytes(5000)), "is no log: neither MCAP"),
    "magic_only.mcap": (lambda path: path.write_bytes(b"\x89MCAP0\r\n"), "is cut off"),
    "summary.mcap": (with_summary_changed, "summary does not match its checksum"),
    "encoding.mcap": (foreign_encoding, "holds keyframes as ros1, not as CDR"),
    "pending.db3": (database_with_pending_log, "was not closed by its recorder"),
    "no_metadata": (folder_without_metadata, "folder without metadata.yaml"),
    "empty_folder": (lambda path: path.mkdir(), "folder without metadata.yaml"),
    "no_file": (folder_without_its_file, "files are missing"),
    "cut_metadata": (folder_with("metadata.yaml", lambda b: b[: len(b) // 3]), "cannot be read"),
    "empty_metadata": (folder_with("metadata.yaml", lambda b: b""), "cannot be read"),
    "text_metadata": (folder_with("metadata.yaml", lambda b: b"{[}\n"), "cannot be read"),
    "list_metadata": (folder_with("metadata.yaml", lambda b: b"- 1\n- 2\n"), "cannot be read"),
    "new_metadata": (folder_with("metadata.yaml", lambda b: b.replace(b"version: 9", b"version: 99")), "99"),
    "cut_db3": (folder_with("cut_db3.db3", lambda b: b[: len(b) // 2]), "cut_db3.db3"),
    "pointer_db3": (folder_with("pointer_db3.db3", lambda b: LFS.encode()), "pointer_db3.db3 is a git-LFS pointer"),
    "cut_mcap": (folder_with_cut_mcap, "cut_mcap.mcap is cut off .* but metadata.yaml announces 24: copy it again"),
}


@pytest.mark.parametrize(("name", "make", "words"), [(name, *bad) for name, bad in BAD.items()])
def test_bad_log_is_one_sentence(name, make, words, tmp_path):
    path = tmp_path / name
    make(path)
    with pytest.raises(LogError, match=words) as error:
        read(path)
    assert_one_sentence(error, path)


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is unreadable to root")
def test_unreadable_file(tmp_path):
    path = write_mcap(tmp_path / "run.mcap", some_keyframes(1))
    path.chmod(stat.S_IWUSR)
    with pytest.raises(LogError, match="cannot be read: Permission denied"):
        read(path)


@pytest.mark.parametrize(("kind", "step"), [("rosbag1", 31), ("rosbag1_lz4", 31), ("db3", 151)])
def test_log_cut_anywhere_is_one_sentence(kind, step, tmp_path):
    """Never a part of the messages without an error, and no error but LogError."""
    keyframes = some_keyframes(3, n=2)
    whole = KINDS[kind](tmp_path, keyframes).read_bytes()
    path = tmp_path / f"cut.{kind}"
    for size in sorted({*range(0, len(whole), step), *range(len(whole) - 60, len(whole))}):
        path.write_bytes(whole[:size])
        with pytest.raises(LogError) as error:
            read(path)
        assert_one_sentence(error, path)


@pytest.mark.parametrize("chunk_size", [0, 1, 4000])
def test_an_mcap_file_cut_anywhere_gives_what_is_whole_and_says_so(chunk_size, tmp_path, capsys):
    """As a recorder leaves it that crashed. Without any whole message it is an error."""
    options = {"chunk_size": chunk_size} if chunk_size else {"use_chunking": False}
    path, keyframes = tmp_path / "run.mcap", some_keyframes(9, n=2)
    whole = write_plain_mcap(path, keyframes, **options).read_bytes()
    lengths = []
    for size in sorted({*range(0, len(whole), 97), *range(len(whole) - 60, len(whole))}):
        path.write_bytes(whole[:size])
        capsys.readouterr()
        try:
            with Log(path) as log:
                got = [keyframe for _, keyframe, _ in log.keyframes()]
        except LogError as error:
            assert not lengths and ("is cut off after" in str(error) or "is empty" in str(error))
            continue
        for keyframe, back in zip(keyframes, got, strict=False):
            assert_same_keyframe(keyframe, back)
        lengths.append(len(got))
        told = capsys.readouterr().err
        assert told.count("\n") == 1 and f"the first {len(got)} messages" in told and f"of {size} bytes" in told
    assert lengths == sorted(lengths) and lengths[-1] == len(keyframes) and len(set(lengths)) > 2


def test_zeros_where_the_rest_of_an_mcap_file_should_be(tmp_path, capsys):
    """As a file system leaves it that lost power."""
    path, keyframes = tmp_path / "run.mcap", some_keyframes(12, n=2)
    whole = write_plain_mcap(path, keyframes, chunk_size=2000).read_bytes()
    path.write_bytes(whole[: chunks_of(path)[2] + 40] + bytes(5000))
    assert read(path) == list(range(len(read(path)))) and 0 < len(read(path)) < 12
    assert "is cut off or was not closed by its recorder" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["mcap", "rosbag1", "rosbag1_lz4", "rosbag1_bz2", "db3"])
def test_changed_bytes_are_read_or_refused(kind, tmp_path):
    """A changed byte gives keyframes or a LogError; in MCAP, which has checksums, never other keyframes."""
    rng = np.random.default_rng(22)
    keyframes = some_keyframes(3, n=2)
    whole = KINDS[kind](tmp_path, keyframes).read_bytes()
    path = tmp_path / f"changed.{kind}"
    refused = 0
    for k in rng.choice(len(whole), 400, replace=len(whole) < 400):
        changed = bytearray(whole)
        changed[k] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        try:
            with Log(path) as log:
                read_back = [keyframe for _, keyframe, _ in log.keyframes()]
        except LogError as error:
            refused += 1
            assert str(error).count("\n") == 0
        else:
            if kind == "mcap":
                for keyframe, back in zip(keyframes, read_back, strict=True):
                    assert_same_keyframe(keyframe, back)
    assert refused


@pytest.mark.parametrize("compression", list(CompressionType))
def test_corrupt_chunk_is_told_by_its_checksum(compression, tmp_path):
    path, keyframes = tmp_path / "run.mcap", some_keyframes(20, full=False)
    whole = bytearray(write_plain_mcap(path, keyframes, compression=compression).read_bytes())
    at = whole.find(keyframes[9].features.descriptors.tobytes())
    assert at > 0 or compression is CompressionType.ZSTD
    whole[at if at > 0 else len(whole) // 3] ^= 1
    path.write_bytes(whole)
    with pytest.raises(LogError, match=r"(?i)checksum|cannot be read") as error:
        read(path)
    assert_one_sentence(error, path)


@pytest.mark.parametrize(
    "options",
    [
        {"chunk_size": 1},
        {"chunk_size": 3000, "compression": CompressionType.LZ4},
        {"use_statistics": False},
        {"use_chunking": False},
        {"use_chunking": False, "index_types": IndexType.NONE, "use_statistics": False},
        {"index_types": IndexType.CHUNK},
        {"index_types": IndexType.NONE},
        {"repeat_channels": False, "repeat_schemas": False},
        {"enable_crcs": False, "compression": CompressionType.NONE},
    ],
)
def test_mcap_as_others_write_it(options, tmp_path):
    rng = np.random.default_rng(23)
    times = [5, 3, 3, 9, 3, 5, 5, 1, 9, 3] * 4  # out of order and equal across chunks
    keyframes = [a_keyframe(rng, id=k, stamp_ns=T0 + t, n=2) for k, t in enumerate(times)]
    expected = sorted(range(len(times)), key=lambda k: times[k])
    with Log(write_plain_mcap(tmp_path / "run.mcap", keyframes, **options)) as log:
        assert [keyframe.id for _, keyframe, _ in log.keyframes()] == expected
