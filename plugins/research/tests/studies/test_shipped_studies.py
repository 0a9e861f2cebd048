"""The table of a shipped study, of which one scene is left out of the training."""

import leave_one_scene_out
import pytest

TABLE = """
scene left out; locus; tokengs; nearest input; mean colour; seeds
desk; 11.00; 12.00; 9.00; 7.00; 0, 1
walk; 14.00; ; 9.00; 7.00; 0
mean of full rows; 11.00; 12.00; 9.00; 7.00;
"""


def test_the_table_of_scenes_left_out_compares_the_same_seeds(tmp_path):
    """LocusGS has a third seed, a lucky one, and of the second scene alone there are results."""

    def judge(scene, variant, seed, psnr):
        folder = tmp_path / f"{scene}/study/runs/{variant}/seed-{seed}/evaluation"
        folder.mkdir(parents=True)
        head = "scene,model_psnr,nearest_input_psnr,mean_colour_psnr"
        (folder / "scenes.csv").write_text(f"{head}\nw0,{psnr},9.0,7.0\n")
        (folder / "protocol.json").write_text("{}")

    for seed, psnr in enumerate((10.0, 12.0, 20.0)):
        judge("desk", "locus", seed, psnr)
    for seed, psnr in enumerate((11.0, 13.0)):
        judge("desk", "tokengs", seed, psnr)
    judge("walk", "locus", 0, 14.0)
    rows = ["; ".join(row).rstrip() for row in leave_one_scene_out.table_rows(tmp_path)]
    assert rows == TABLE.strip("\n").splitlines()
    judge("walk", "tokengs", 0, "")
    with pytest.raises(ValueError, match="model_psnr"):
        leave_one_scene_out.table_rows(tmp_path)
