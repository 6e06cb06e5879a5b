"""Damaged logs: one sentence or keyframes, never another error; of MCAP, which has checksums, never wrong ones in silence."""

import pytest
from log_damage import damaged, read
from log_samples import KINDS, some_keyframes
from message_samples import assert_same_keyframe


@pytest.mark.parametrize("kind", ["mcap", "rosbag2_mcap_zstd_chunk", "db3", "rosbag1", "rosbag1_lz4"])
def test_damaged_logs(kind, tmp_path, capsys):
    keyframes = some_keyframes(3, n=2)
    path = KINDS[kind](tmp_path, keyframes)
    whole = (path if path.is_file() else path / "run.mcap").read_bytes()
    refused = 0
    for seed in range(100):
        (tmp_path / "damaged").write_bytes(damaged(whole, seed))
        capsys.readouterr()
        found, error = read(tmp_path / "damaged")
        refused += bool(error)
        assert "\n" not in error
        if kind == "mcap":
            for keyframe, back in zip(keyframes, found, strict=False):
                assert_same_keyframe(keyframe, back)
            assert len(found) == len(keyframes) or error or capsys.readouterr().err
    assert refused > 10
