"""Read LLFF's scenes: `poses_bounds.npy` beside a folder of photos (Mildenhall et al., 2019)."""

import numpy as np
from upath import UPath

from qgs.data.images import load_array
from qgs.data.photos.reader import Listing, PhotoFrame, PhotoReader, image_folder, listed_size
from qgs.paths import open_file
from qgs_photos.image_files import image_files


class Llff(PhotoReader):
    """Reader of LLFF's scenes. Row N of `poses_bounds.npy` belongs to the Nth photo by name.

    A row has 17 numbers: a (3, 5) matrix, then near and far. Columns of the matrix: the camera's
    axes down, right and back, and its centre, all in world coordinates; the last column is height,
    width and focal length in pixels. The principal point is the middle of the photo. Near and far
    are checked, but not used.
    """

    listing = "poses_bounds.npy"

    @classmethod
    def read(cls, folder: UPath, images: str | None) -> Listing:
        """Read the photos of `folder` and their cameras in poses_bounds.npy.

        images: folder with scaled copies of the photos to read, such as images_4; None reads the
        default folder. Raises ValueError if there are not as many photos as rows.
        """
        file = folder / cls.listing
        photos = image_folder(folder, images)
        rows = _rows(file)
        files = image_files(photos)
        if len(files) != len(rows):
            raise ValueError(
                f"{file} has {len(rows)} poses, but {photos} has {len(files)} images: poses belong "
                "to images in the order of names, so give all images and no others"
            )
        return Listing(file, [_frame(*pair) for pair in zip(files, rows, strict=True)])


def _rows(file: UPath) -> np.ndarray:
    """Return N rows of 3 x 5 matrix, near, far; raise ValueError for other data or near > far."""
    try:
        with open_file(file) as opened:
            rows = load_array(opened)
    except Exception as error:
        # NumPy raises anything on damaged headers
        raise ValueError(
            f"{file} is not a NumPy file of numbers ({error}): export it again"
        ) from error
    if rows.dtype.kind not in "fiu" or rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise ValueError(f"{file} must have shape (N, 17), got {rows.shape}: export it again")
    if (wrong := np.flatnonzero(~(rows[:, 15] <= rows[:, 16]))).size:
        near, far = rows[wrong[0], 15:]
        raise ValueError(
            f"{file}, row {wrong[0]}: near {near:g} must be at most far {far:g}: "
            "export it again with near and far at the end of each row"
        )
    return rows.astype(np.float64)


def _frame(path: UPath, row: np.ndarray) -> PhotoFrame:
    # Columns of a 3 x 5 matrix: axes and centre of the camera, then its size and focal length.
    down, right, back, centre, lens = row[:15].reshape(3, 5).T
    height, width, focal = lens.tolist()
    c2w = np.eye(4)
    # OpenCV's axes
    c2w[:3] = np.c_[right, down, -back, centre]
    size, problems = listed_size(height, width)
    return PhotoFrame(
        name=f"{path.parent.name}/{path.name}",
        path=path,
        c2w=c2w,
        intrinsics=(focal, focal, width / 2, height / 2),
        size=size,
        problems=problems,
    )
