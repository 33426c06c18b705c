//! Files are read back unchanged, and invalid ones are refused with one message.

use gump_scene::Seed;

use super::*;
use crate::config::VisualConfig;

fn small() -> ModelConfig {
    let visual = VisualConfig {
        side_px: 40,
        metres_per_px: 5.0,
        ..ModelConfig::tiny().visual
    };
    ModelConfig {
        width: 16,
        heads: 2,
        layers: 1,
        block_size: 64,
        trajectory_heads: vec![],
        visual,
        ..ModelConfig::tiny()
    }
}

/// Runs a test with a file in a temporary folder.
fn with_file(test: impl FnOnce(&Path)) {
    let folder = tempfile::tempdir().unwrap();
    test(&folder.path().join("weights.safetensors"));
}

fn write_tensors(
    path: &Path,
    change: impl FnOnce(&mut BTreeMap<String, Tensor>, &mut BTreeMap<String, String>),
) {
    let network = Network::random(small(), Seed(1), &Device::Cpu).unwrap();
    let named = network.parameters().all();
    let mut tensors: BTreeMap<String, Tensor> = named
        .map(|(name, var)| (name.to_owned(), var.as_tensor().clone()))
        .collect();
    let mut metadata = header(network.config()).unwrap();
    change(&mut tensors, &mut metadata);
    write(path, tensors, metadata, StorageType::Full).unwrap();
}

/// Loading must fail with one line that names the file and contains `expected`.
fn check_refused(path: &Path, expected: &str) {
    let message = load(path, &Device::Cpu).unwrap_err().to_string();
    assert!(
        message.contains(expected) && message.contains("weights.safetensors"),
        "{message}"
    );
    assert!(!message.contains('\n'), "{message}");
}

#[test]
fn equal_weights_are_equal_bytes() {
    with_file(|path| {
        let bytes = || {
            write_tensors(path, |_, metadata| {
                metadata.extend((0..9).map(|i| (format!("note {i}"), i.to_string())));
            });
            fs::read(path).unwrap()
        };
        let first = bytes();
        assert!((0..4).all(|_| bytes() == first));
        load(path, &Device::Cpu).unwrap();
    });
}

#[test]
fn weights_come_back() {
    with_file(|path| {
        let network = Network::random(small(), Seed(1), &Device::Cpu).unwrap();
        save(&network, path, StorageType::Full).unwrap();
        let loaded = load(path, &Device::Cpu).unwrap();
        assert_eq!(loaded.config(), network.config());
        for ((name, a), (_, b)) in network.parameters().all().zip(loaded.parameters().all()) {
            let values = |v: &candle_core::Var| v.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            assert_eq!(values(a), values(b), "{name}");
        }
        let beside = fs::read_dir(path.parent().unwrap()).unwrap().count();
        assert_eq!(beside, 1, "nothing partial is left");
    });
}

#[test]
fn weights_without_marks_grow_them_and_say_the_same() {
    with_file(|path| {
        let config = |unknown_marks: bool| ModelConfig {
            unknown_marks,
            block_size: 256,
            ..small()
        };
        let network = Network::random(config(false), Seed(1), &Device::Cpu).unwrap();
        save(&network, path, StorageType::Full).unwrap();
        let grown = load_to_grow(path, &config(true), &Device::Cpu).unwrap();
        let grown = grown.expect("the same model but for the marks");
        assert_eq!(*grown.config(), config(true));
        // A scene whose limit is unknown, so that a mark is set.
        let scenario = gump_scene::fixture::scenario(
            "lane 1: -100,0 100,0
             ego vehicle 0: 0,0 velocity 8,0
             agent vehicle 1: 20,0 velocity 5,0",
        )
        .unwrap();
        let slots = crate::testing::slots(&scenario);
        let outputs = |network: &Network| {
            let memory = crate::testing::memory(network, &scenario);
            crate::testing::hidden(network, &[&slots], &memory)
                .concat()
                .concat()
        };
        let pairs = outputs(&network).into_iter().zip(outputs(&grown));
        let off = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(off < 1e-5, "{off}");
        // The other way round, and into another model, nothing grows.
        save(&grown, path, StorageType::Full).unwrap();
        let load = |config| load_to_grow(path, &config, &Device::Cpu).unwrap();
        assert!(load(config(false)).is_none());
        let wider = ModelConfig {
            layers: 2,
            ..config(true)
        };
        assert!(load(wider).is_none());
        assert!(load(config(true)).is_some());
    });
}

#[test]
fn another_vocabulary_is_refused() {
    with_file(|path| {
        write_tensors(path, |_, metadata| {
            metadata.insert("vocabulary".into(), "3174".into());
        });
        check_refused(path, "vocabulary has 3174 tokens, expected 2972");
    });
}

#[test]
fn another_shape_is_refused() {
    with_file(|path| {
        write_tensors(path, |tensors, _| {
            let slots = Tensor::zeros((14, 16), DType::F32, &Device::Cpu).unwrap();
            tensors.insert("decoder.slots".into(), slots);
        });
        check_refused(
            path,
            "\"decoder.slots\" has shape [14, 16], expected [16, 16]",
        );
    });
}

#[test]
fn missing_and_surplus_tensors_are_named() {
    with_file(|path| {
        write_tensors(path, |tensors, _| drop(tensors.remove("mct.norm.weight")));
        check_refused(path, "\"mct.norm.weight\" is missing");
        write_tensors(path, |tensors, _| {
            let extra = Tensor::zeros(1, DType::F32, &Device::Cpu).unwrap();
            tensors.insert("mct.extra".into(), extra);
        });
        check_refused(path, "\"mct.extra\" has no place");
    });
}

#[test]
fn what_is_no_checkpoint_is_refused() {
    with_file(|path| {
        check_refused(path, "No such file");
        for bytes in [&b""[..], b"GIF89a", &[0xff; 64]] {
            fs::write(path, bytes).unwrap();
            check_refused(path, "expected a safetensors file");
        }
        write_tensors(path, |_, _| ());
        let whole = fs::read(path).unwrap();
        for cut in [1, whole.len() / 2, whole.len() - 1] {
            fs::write(path, &whole[..cut]).unwrap();
            check_refused(path, "weights");
        }
        write_tensors(path, |_, metadata| drop(metadata.remove("format")));
        check_refused(path, "not a gump checkpoint");
    });
}

#[test]
fn a_folder_that_is_not_there_is_an_error_and_leaves_nothing() {
    let network = Network::random(small(), Seed(1), &Device::Cpu).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("nowhere").join("weights.safetensors");
    assert!(
        save(&network, &path, StorageType::Half)
            .unwrap_err()
            .to_string()
            .contains("nowhere")
    );
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
}
