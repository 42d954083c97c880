//! Checks the access rules of `fanout.*` before `fanout` starts. Beyond loopback every viewer must authenticate.

use std::{
    io::ErrorKind,
    net::{TcpListener, ToSocketAddrs as _},
    os::{
        linux::net::SocketAddrExt as _,
        unix::{
            fs::PermissionsExt as _,
            net::{SocketAddr, UnixListener},
        },
    },
    path::PathBuf,
    sync::{Mutex, PoisonError},
};

use ipc_schema::config::{Commander, EndpointProtocol, FanoutConfig, FanoutEndpoint};

use crate::{display::notice, failure::Exit};

/// The endpoint of the presets: a run that keeps it may listen on another port.
const DEFAULT_ENDPOINT: &str = "tcp/127.0.0.1:7447";

/// Checks the endpoint, the files and their permissions, and makes their paths absolute.
///
/// # Errors
/// The endpoint cannot be listened on or would admit unauthenticated viewers from other machines, or a file is missing or readable
/// by other users.
pub fn check(fanout: &mut FanoutConfig) -> Result<(), Exit> {
    if !fanout.enabled {
        return Ok(());
    }
    check_endpoint(fanout)?;
    for (key, path) in [
        ("users", &mut fanout.users),
        ("tls_certificate", &mut fanout.tls_certificate),
        ("tls_private_key", &mut fanout.tls_private_key),
        ("tls_client_ca", &mut fanout.tls_client_ca),
    ] {
        if let Some(path) = path {
            resolve_readable(key, path)?;
        }
    }
    check_secrets(fanout)?;
    check_users(fanout)
}

/// Checks the endpoint. If the default one is in use, a free port takes its place.
fn check_endpoint(fanout: &mut FanoutConfig) -> Result<(), Exit> {
    let listen = fanout.listen.clone();
    let is_encrypted = listen.protocol == EndpointProtocol::Tls;
    let has_certificate = fanout.tls_certificate.is_some() && fanout.tls_private_key.is_some();
    if is_encrypted && !has_certificate {
        return Err(Exit::config(
            format!("`fanout.listen` = \"{listen}\" needs a certificate"),
            "set fanout.tls_certificate and fanout.tls_private_key; docs/remote.md shows how openssl makes them",
        ));
    }
    if !is_encrypted && fanout.tls_client_ca.is_some() {
        return Err(Exit::config(
            "`fanout.tls_client_ca` requires client certificates, which tcp does not support",
            "listen on tls/HOST:PORT, or set fanout.tls_client_ca = \"\"",
        ));
    }
    let address = listen.address();
    if is_beyond_loopback(&address) && fanout.users.is_none() && fanout.tls_client_ca.is_none() {
        return Err(Exit::config(
            format!("`fanout.listen` = \"{listen}\" would admit viewers from other machines without authentication"),
            "list the users in fanout.users, or require certificates with fanout.tls_client_ca (docs/remote.md); or listen on 127.0.0.1 \
             and connect viewers through a tunnel: ssh -N -L 7447:127.0.0.1:7447 HOST",
        ));
    }
    // Of unencrypted connections `fanout` passes on those of its own user alone.
    if is_encrypted && fanout.users.is_none() && fanout.tls_client_ca.is_none() {
        return Err(Exit::config(
            format!("`fanout.listen` = \"{listen}\" would admit every user of this machine"),
            "list the users in fanout.users, or require certificates with fanout.tls_client_ca (docs/remote.md); or listen on \
             tcp/127.0.0.1:7447, which admits you alone",
        ));
    }
    let refuse = |error: std::io::Error| {
        Exit::config(
            format!("`fanout.listen` = \"{listen}\" cannot be listened on: {error}"),
            "if another run or program uses the port, choose another, e.g. --set fanout.listen=tcp/127.0.0.1:7448, or --set fanout.enabled=false",
        )
    };
    // A run that has just started may listen on the port in a moment.
    let bound = match claim_address(&address) {
        true => TcpListener::bind(&address).map(drop),
        false => Err(ErrorKind::AddrInUse.into()),
    };
    match bound {
        Ok(()) => Ok(()),
        Err(error) if error.kind() == ErrorKind::AddrInUse && listen.to_string() == DEFAULT_ENDPOINT => {
            let free = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
            let free = free.map_err(refuse)?;
            notice(&format!(
                "viewers connect to tcp/{free}: another run or program uses {DEFAULT_ENDPOINT}"
            ));
            fanout.listen = FanoutEndpoint {
                protocol: EndpointProtocol::Tcp,
                host: free.ip().to_string(),
                port: free.port(),
            };
            Ok(())
        }
        Err(error) => Err(refuse(error)),
    }
}

/// Claims an address of this machine for this program until it ends. False if another run has claimed it: its `fanout` listens there
/// later than its supervisor checks the address.
///
/// The claim is an abstract socket: it holds for all users, leaves no file, and ends with the program however that ends.
fn claim_address(address: &str) -> bool {
    static CLAIM: Mutex<Option<(String, UnixListener)>> = Mutex::new(None);
    let mut claim = CLAIM.lock().unwrap_or_else(PoisonError::into_inner);
    if claim.as_ref().is_some_and(|(claimed, _)| claimed == address) {
        return true;
    }
    let name = SocketAddr::from_abstract_name(format!("caraware-{address}"));
    match name.and_then(|name| UnixListener::bind_addr(&name)) {
        Ok(listener) => *claim = Some((address.to_owned(), listener)),
        Err(error) if error.kind() == ErrorKind::AddrInUse => return false,
        // Without claims the address itself decides.
        Err(error) => tracing::debug!(%error, address, "cannot claim"),
    }
    true
}

/// True unless every address that the name resolves to is a loopback address.
fn is_beyond_loopback(address: &str) -> bool {
    address.to_socket_addrs().map_or(true, |mut addresses| {
        addresses.any(|address| !address.ip().is_loopback())
    })
}

/// Makes the path absolute and checks that the file can be opened.
fn resolve_readable(key: &str, path: &mut PathBuf) -> Result<(), Exit> {
    let absolute = std::path::absolute(&*path).map_err(|error| Exit::io("resolve", path, &error))?;
    std::fs::File::open(&absolute).map_err(|error| {
        Exit::config(
            format!("`fanout.{key}` = \"{}\" cannot be read: {error}", path.display()),
            "give a readable file; docs/remote.md shows how to make it",
        )
    })?;
    *path = absolute;
    Ok(())
}

/// Refuses files of passwords and private keys that other users can read.
fn check_secrets(fanout: &FanoutConfig) -> Result<(), Exit> {
    for (key, path) in [("users", &fanout.users), ("tls_private_key", &fanout.tls_private_key)] {
        let Some(path) = path else { continue };
        let data = std::fs::metadata(path).map_err(|error| Exit::io("read", path, &error))?;
        if data.permissions().mode() & 0o077 != 0 {
            let path = path.display();
            return Err(Exit::config(
                format!("`fanout.{key}` = \"{path}\" can be read by other users of this machine"),
                format!("chmod 600 {path}"),
            ));
        }
    }
    Ok(())
}

/// Checks that each line of the file of users is `user:password`, and that every commander is one of its users.
fn check_users(fanout: &FanoutConfig) -> Result<(), Exit> {
    let mut known = Vec::new();
    if let Some(path) = &fanout.users {
        let text = std::fs::read_to_string(path).map_err(|error| Exit::io("read", path, &error))?;
        for (number, line) in (1..).zip(text.lines()).filter(|(_, line)| !line.is_empty()) {
            match line.split_once(':') {
                Some((user, password)) if !user.is_empty() && !password.is_empty() => known.push(user.to_owned()),
                _ => {
                    return Err(Exit::config(
                        format!("{}, line {number}: not user:password", path.display()),
                        "write one line for each user, for example alice:her-password",
                    ));
                }
            }
        }
        if known.is_empty() {
            return Err(Exit::config(
                format!("`fanout.users` = \"{}\" lists no user", path.display()),
                "write one line for each user, for example alice:her-password",
            ));
        }
    }
    let unknown = fanout.commanders.iter().find_map(|commander| match commander {
        Commander::Named(name) if !known.contains(name) => Some(name),
        Commander::Named(_) | Commander::EveryClient => None,
    });
    match unknown {
        // With `tls_client_ca` a name may be the common name of a certificate, which is only known when a client connects.
        Some(name) if fanout.tls_client_ca.is_none() => Err(Exit::config(
            format!("`fanout.commanders` lists \"{name}\", which is not a user of the file `fanout.users`"),
            "add a line for this user to that file, or remove the name; \"*\" means every user that may connect",
        )),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(change: impl FnOnce(&mut FanoutConfig)) -> Option<String> {
        let settings = crate::config::LayeredSettings::defaults().unwrap();
        let mut fanout = settings.validate().unwrap().fanout;
        fanout.listen = "tcp/127.0.0.1:0".parse().unwrap();
        change(&mut fanout);
        match check(&mut fanout) {
            Ok(()) => None,
            Err(Exit::Failure(failure)) => Some(failure.message),
            Err(exit) => panic!("{exit:?}"),
        }
    }

    fn file(directory: &tempfile::TempDir, name: &str, text: &str, mode: u32) -> Option<PathBuf> {
        let path = directory.path().join(name);
        std::fs::write(&path, text).unwrap();
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).unwrap();
        Some(path)
    }

    #[test]
    fn beyond_loopback_every_viewer_must_authenticate() {
        let directory = tempfile::tempdir().unwrap();
        let users = file(&directory, "users", "alice:secret\n", 0o600);
        let pem = file(&directory, "pem", "", 0o600);
        for listen in ["tcp/0.0.0.0:0", "tcp/[::]:0", "tls/0.0.0.0:0"] {
            let open = message(|fanout| {
                fanout.listen = listen.parse().unwrap();
                (fanout.tls_certificate, fanout.tls_private_key) = (pem.clone(), pem.clone());
            });
            assert!(open.unwrap().contains("without authentication"), "{listen}");
            let closed = message(|fanout| {
                fanout.listen = listen.parse().unwrap();
                fanout.users = users.clone();
                (fanout.tls_certificate, fanout.tls_private_key) = (pem.clone(), pem.clone());
            });
            assert_eq!(closed, None, "{listen}");
        }
        assert_eq!(message(|_| {}), None);
        assert_eq!(
            message(|fanout| fanout.listen = "tcp/localhost:0".parse().unwrap()),
            None
        );
    }

    #[test]
    fn every_mistake_has_its_message() {
        let directory = tempfile::tempdir().unwrap();
        let users = file(&directory, "users", "alice:secret\n", 0o600);
        let open = file(&directory, "open", "alice:secret\n", 0o644);
        let bare = file(&directory, "bare", "alice\n", 0o600);
        let empty = file(&directory, "empty", "\n", 0o600);
        let says = |part: &str, change: &dyn Fn(&mut FanoutConfig)| {
            let message = message(change).unwrap_or_default();
            assert!(message.contains(part), "{part}: {message}");
        };
        says("needs a certificate", &|fanout| {
            fanout.listen = "tls/127.0.0.1:0".parse().unwrap();
        });
        says("would admit every user of this machine", &|fanout| {
            fanout.listen = "tls/127.0.0.1:0".parse().unwrap();
            (fanout.tls_certificate, fanout.tls_private_key) = (users.clone(), users.clone());
        });
        says("cannot be read", &|fanout| fanout.users = Some("/nowhere/users".into()));
        says("by other users", &|fanout| fanout.users = open.clone());
        says("line 1: not user:password", &|fanout| fanout.users = bare.clone());
        says("lists no user", &|fanout| fanout.users = empty.clone());
        says("is not a user of the file", &|fanout| {
            fanout.users = users.clone();
            fanout.commanders = vec![Commander::Named("bob".into())];
        });
        says("which tcp does not support", &|fanout| {
            fanout.tls_client_ca = users.clone();
        });
    }
}
