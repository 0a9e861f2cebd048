"""A training in two processes, as a launcher starts them."""

import multiprocessing
import os
import signal
import socket
import traceback
from concurrent.futures import ProcessPoolExecutor

import pytest
import torch
from accelerate.state import AcceleratorState
from training_runs import resume, spoil

from qgs.data.stream import SampleError
from qgs.recipe import resolve


def train_as(rank, port, tree, folder, *spoiled):
    """What one of the processes does; it ends, and with it the other, at any other error."""
    signal.alarm(240)  # after which processes that wait for each other are ended
    torch.set_num_threads(1)
    os.environ |= {"MASTER_ADDR": "localhost", "MASTER_PORT": str(port), "WORLD_SIZE": "2"}
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank)}
    AcceleratorState._reset_state(reset_partial_state=True)
    if spoiled:
        spoil(pytest.MonkeyPatch(), *spoiled)
    try:
        result = resume(resolve(tree), folder)
    except SampleError as error:
        return f"{error}; {getattr(error, '__notes__', '')}"
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    weights = result.model.parameters()
    total = sum(float(p.detach().double().abs().sum()) for p in weights)
    return result.main, result.steps, total


def told_by_two(recipe, folder, *spoiled):
    """Continue or start the run in `folder`; what each process knows of it, or its error.

    spoiled: arguments of `spoil`.
    """
    with socket.create_server(("localhost", 0)) as free:
        port = free.getsockname()[1]
    # Forked, processes need not import anything; with a CUDA torch they could not train.
    context = multiprocessing.get_context("spawn" if torch.cuda.is_available() else "fork")
    with ProcessPoolExecutor(2, context) as pool:
        options = port, dict(recipe.tree), folder, *spoiled
        jobs = [pool.submit(train_as, rank, *options) for rank in (0, 1)]
        return [job.result() for job in jobs]
